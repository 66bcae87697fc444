#pragma once
// Random numbers without state: a pure function of a counter and a seed.
#include <cstdint>

#include "portable.h"

namespace gs {

struct RandomWords {
  uint32_t w[4];
};

// Philox-4x32-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3").
GS_HD RandomWords philox(const RandomWords& counter, uint64_t seed) {
  uint32_t c0 = counter.w[0], c1 = counter.w[1], c2 = counter.w[2], c3 = counter.w[3];
  uint32_t k0 = uint32_t(seed), k1 = uint32_t(seed >> 32);
  for (int round = 0; round < 10; ++round) {
    const uint64_t product0 = uint64_t(0xd2511f53u) * c0, product1 = uint64_t(0xcd9e8d57u) * c2;
    c0 = uint32_t(product1 >> 32) ^ c1 ^ k0, c1 = uint32_t(product1);
    c2 = uint32_t(product0 >> 32) ^ c3 ^ k1, c3 = uint32_t(product0);
    k0 += 0x9e3779b9u, k1 += 0xbb67ae85u;
  }
  return {{c0, c1, c2, c3}};
}

// Four standard normal numbers (Box and Muller 1958), of which words 0 and 2 decide lengths, 1 and 3 directions.
template <class T>
GS_HD void normals(const RandomWords& bits, T (&out)[4]) {
  for (int pair = 0; pair < 2; ++pair) {
    const T uniform = (T(bits.w[2 * pair]) + 1) * T(0x1p-32);  // in (0, 1]
    const T radius = std::sqrt(portable::log(uniform) * -2);
    portable::CosSin<T> turn;
    portable::cos_sin_turns(bits.w[2 * pair + 1], turn);
    out[pair] = rounded_product(radius, turn.cos), out[pair + 2] = rounded_product(radius, turn.sin);
  }
}

}  // namespace gs
