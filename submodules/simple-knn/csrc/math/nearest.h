#pragma once
// Squared distances and the three smallest of them.
#include <cstdint>
#include <limits>

#include "gs/hd.h"

namespace gs {

template <class T>
constexpr T kLargest = std::numeric_limits<T>::max();

// a * b, rounded before it is added to anything: nvcc would fuse the two, and the result would differ from the CPU's.
template <class T>
GS_HD T product(T a, T b) {
#ifdef __CUDA_ARCH__
  if constexpr (sizeof(T) == sizeof(float))
    return __fmul_rn(a, b);
  else
    return __dmul_rn(a, b);
#else
  return a * b;
#endif
}

// The squared length of (x, y, z), at most the largest finite number. Rounding is monotone in |x|, |y| and |z|. So the
// distance to a box, which is computed here too, never exceeds that to a point inside it.
template <class T>
GS_HD T squared_length(T x, T y, T z) {
  const T sum = product(x, x) + product(y, y) + product(z, z);
  return sum < kLargest<T> ? sum : kLargest<T>;
}

// The three smallest distances so far, ascending; infinite where there were fewer.
template <class T>
struct Nearest3 {
  static constexpr T kNone = std::numeric_limits<T>::infinity();
  T d0 = kNone, d1 = kNone, d2 = kNone;

  GS_HD void add(T d) {
    if (!(d < d2)) return;
    d2 = d < d1 ? d1 : d;
    if (d < d1) d1 = d < d0 ? d0 : d;
    if (d < d0) d0 = d;
  }

  // Their mean, 0 if there were none; at most the largest finite number.
  GS_HD T mean() const {
    if (d0 == kNone) return 0;
    if (d1 == kNone) return d0;
    const T sum = d2 == kNone ? d0 + d1 : d0 + d1 + d2;
    return sum < kLargest<T> ? sum / (d2 == kNone ? 2 : 3) : kLargest<T>;
  }
};

}  // namespace gs
