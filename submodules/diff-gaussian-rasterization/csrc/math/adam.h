#pragma once
// A step of Adam for one value, and its guard.
#include <cmath>
#include <cstdint>

#include "../data.h"
#include "gs/hd.h"
#include "gs/isa.h"
#include "vec.h"

GS_ISA_BEGIN

// The constants of one step of Adam (Kingma and Ba 2015, algorithm 1), arranged as torch does: eps is added to the
// corrected root.
template <class T>
struct AdamStep {
  T keep1, take1;     // beta1, 1 - beta1; the difference is computed in double (1 - 0.999f is off by 5e-5)
  T keep2, take2;     // beta2, 1 - beta2
  T rate;             // lr / (1 - beta1^t)
  T root_correction;  // 1 / sqrt(1 - beta2^t)
  T eps;
};

template <class T>
GS_HD AdamStep<T> make_adam_step(double lr, double beta1, double beta2, double eps, double step) {
  return {T(beta1),
          T(1 - beta1),
          T(beta2),
          T(1 - beta2),
          T(lr / (1 - std::pow(beta1, step))),
          T(1 / std::sqrt(1 - std::pow(beta2, step))),
          T(eps)};
}

// The same without the bias corrections: the step of sparse Adam (Mallick et al. 2024, Taming 3DGS), which does not
// count the steps of a row.
template <class T>
GS_HD AdamStep<T> make_uncorrected_adam_step(double lr, double beta1, double beta2, double eps) {
  return {T(beta1), T(1 - beta1), T(beta2), T(1 - beta2), T(lr), T(1), T(eps)};
}

// The operations of a step on a scalar; Simd (gs/simd.h) has them on vectors.
template <class T>
struct OneLane {
  static GS_HD T all(T x) { return x; }
  static GS_HD T root(T x) { return std::sqrt(x); }
  static GS_HD T multiply_add(T a, T b, T c) { return GS_ISA::multiply_add(a, b, c); }
};

// V is a scalar or a vector, Lanes has its operations. Which products are fused with a sum is said here and not left to
// compilers, so a value's step has the same bits wherever it is taken: alone, in a vector, or beside its gradient.
template <class Lanes, class T, class V>
GS_HD void adam(const AdamStep<T>& a, V gradient, V& value, V& mean, V& square) {
  mean = Lanes::multiply_add(Lanes::all(a.keep1), mean, a.take1 * gradient);
  square = Lanes::multiply_add(Lanes::all(a.keep2), square, a.take2 * gradient * gradient);
  const V divisor = Lanes::multiply_add(Lanes::root(square), Lanes::all(a.root_correction), Lanes::all(a.eps));
  value = Lanes::multiply_add(Lanes::all(-a.rate), mean / divisor, value);
}

// Tells whether the tensors take their step in this iteration.
template <class T>
GS_HD bool may_step(const StepGuard<T>& guard) {
  if (!guard.stopped) return true;
  const int64_t stopped =
      *static_cast<const volatile int64_t*>(guard.stopped);  // other threads may set it to this iteration
  return (stopped == 0 || stopped == guard.iteration) && is_finite(*guard.loss);
}

// Takes the step where all its results are finite. Elsewhere the value stays, and its mean becomes NaN as a mark.
// Returns where it was taken: a truth value, or a mask of lanes.
template <class Lanes, class T, class V>
GS_HD auto adam_if_finite(const AdamStep<T>& a, V gradient, V& value, V& mean, V& square) {
  V v = value, m = mean, s = square;
  adam<Lanes>(a, gradient, v, m, s);
  const auto finite = is_finite(v) & is_finite(m) & is_finite(s);
  value = finite ? v : value;
  mean = finite ? m : Lanes::all(T(NAN));
  square = finite ? s : square;
  return finite;
}

GS_ISA_END
