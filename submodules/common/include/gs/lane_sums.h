#pragma once
// Sums over the lanes of several vectors at once.
#include <algorithm>
#include <utility>

#include "gs/simd.h"

GS_ISA_BEGIN

// A vector's lanes are added by halves: lane i to lane i + kLanes / 2, and so on with what is left. This tree is the
// same for all vectors, and turning the lanes round in a circle changes no sum.
template <class T, int kBytes>
class LaneSums {
  using S = Simd<T, kBytes>;
  using Vec = typename S::Vec;
  using Lanes = std::make_integer_sequence<int, S::kLanes>;

 public:
  // out[i] = the sum of v[i]'s lanes.
  template <int kCount>
  static void store(const Vec (&v)[kCount], T* out) {
    if constexpr (S::kLanes > 8) {  // additions of half the width cost less than shuffles of the whole
      using Half = Simd<T, kBytes / 2>;
      typename Half::Vec halves[kCount];
      for (int i = 0; i < kCount; ++i) {
        typename Half::Vec low, high;
        std::memcpy(&low, &v[i], sizeof low);
        std::memcpy(&high, reinterpret_cast<const char*>(&v[i]) + sizeof low, sizeof high);
        halves[i] = low + high;
      }
      LaneSums<T, kBytes / 2>::store(halves, out);
    } else {
      T sums[(kCount + S::kLanes - 1) / S::kLanes * S::kLanes];
      fold<S::kLanes>(v, sums);
      for (int i = 0; i < kCount; ++i) out[i] = sums[i / S::kLanes * S::kLanes + reversed(i % S::kLanes)];
    }
  }

 private:
  // Each part of kPart lanes belongs to one sum. A step halves the parts and puts two vectors into one, so in the end
  // the number of a sum's lane has the bits of the sum's number in reverse.
  template <int kPart, int kCount>
  static void fold(const Vec (&v)[kCount], T* sums) {
    if constexpr (kPart == 1) {
      for (int i = 0; i < kCount; ++i) S::store(sums + i * S::kLanes, v[i]);
    } else {
      Vec folded[(kCount + 1) / 2];
      for (int i = 0; i < kCount; i += 2) {
        const Vec a = v[i], b = v[std::min(i + 1, kCount - 1)];
        folded[i / 2] = halves<kPart, 0>(a, b, Lanes()) + halves<kPart, 1>(a, b, Lanes());
      }
      fold<kPart / 2>(folded, sums);
    }
  }

  // The low (0) or high (1) halves of all parts, those of a and b in turn.
  template <int kPart, int kHigh, int... kLane>
  static Vec halves(Vec a, Vec b, std::integer_sequence<int, kLane...>) {
#ifdef __clang__
    return __builtin_shufflevector(a, b, source(kLane, kPart, kHigh)...);
#else
    return __builtin_shuffle(a, b, typename S::Mask{source(kLane, kPart, kHigh)...});
#endif
  }
  static constexpr int source(int lane, int part, int high) {
    const int half = part / 2, piece = lane / half;
    return piece % 2 * S::kLanes + piece / 2 * part + high * half + lane % half;
  }

  static constexpr int reversed(int number) {
    int out = 0;
    for (int bit = 1; bit < S::kLanes; bit *= 2) out = 2 * out + (number & bit ? 1 : 0);
    return out;
  }
};

GS_ISA_END
