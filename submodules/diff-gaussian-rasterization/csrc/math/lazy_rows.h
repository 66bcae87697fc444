#pragma once
// Steps that rows of SH coefficients take late: a Gaussian that a view does not see has no gradient, yet Adam's
// averages move its values on. Such steps are put off until a view may see it, and then taken one by one.
//
// The bits stay those of a row that takes every step. A zero gradient is +0 in every backward, and the late step is the
// same function of the same constants. A guard needs no late answer: see may_wait.
#include <cmath>

#include "../data.h"
#include "adam.h"
#include "projection.h"

GS_ISA_BEGIN

// Whether a row may wait that has such a value: kLazySteps steps of gradient zero, with constants that may_wait allows,
// stay finite, so that a guard would find nothing. A step moves the value by at most rate |mean| / eps, where rate is
// at most 100, eps at least 1e-16, and |mean| never grows: by 1e33, and all steps together by less than 1e36. The
// square never grows, so its corrected root stays below 1e24.
template <class T>
GS_HD bool may_wait(T value, T mean, T square) {
  return (std::abs(value) <= T(1e37)) & (std::abs(mean) <= T(1e15)) & (square >= T(0)) & is_finite(square);
}

// Whether the constants of a step let rows wait. A rate below zero would turn a value of -0 into +0 where the averages
// are zero, where late steps are left out.
inline bool may_wait(double lr, double beta1, double beta2, double eps) {
  return 0 <= lr && lr <= 1 && 0 <= beta1 && beta1 <= 0.99 && 0 <= beta2 && beta2 <= 0.9999999 && eps >= 1e-16 &&
         eps <= 1;
}

// The place of a step's constants in LazyRows::ring.
GS_HD uint32_t ring_place(int32_t number, int lazy) {
  return (uint32_t(number) % kLazySteps * kLazy + lazy) * kLazyConstants;
}

template <class T>
GS_HD void store_step(const AdamStep<T>& a, T* to) {
  to[0] = a.keep1, to[1] = a.take1, to[2] = a.keep2, to[3] = a.take2;
  to[4] = a.rate, to[5] = a.root_correction, to[6] = a.eps;
}
template <class T>
GS_HD AdamStep<T> load_step(const T* from) {
  from = static_cast<const T*>(__builtin_assume_aligned(from, 16));  // few loads on a GPU
  return {from[0], from[1], from[2], from[3], from[4], from[5], from[6]};
}

// Takes the steps after `last` up to `taken`, with a gradient of zero. Values whose averages are +0 stay: the mean and
// the square stay +0, and a value, even -0, does not change by adding -0, which is -rate times 0.
template <class Lanes, class T, class V>
GS_HD void take_late_steps(const T* ring, int lazy, int32_t last, int32_t taken, V& value, V& mean, V& square) {
  for (int32_t number = last + 1; number <= taken; ++number)
    adam<Lanes>(load_step(ring + ring_place(number, lazy)), Lanes::all(T(0)), value, mean, square);
}

// Whether a view may see Gaussian i; false only if it surely gives it no tile.
template <class T>
GS_HD bool may_be_seen(const Scene<T>& s, const Camera<T>& camera, int64_t i) {
  if (!s.raw) return true;
  return !surely_outside(camera, load3(s.means + 3 * i), [&] {
    const Vec3<T> scales = load3(s.scales + 3 * i);
    return s.scale_modifier * std::exp(larger(larger(scales.x, scales.y), scales.z));
  });
}

GS_ISA_END
