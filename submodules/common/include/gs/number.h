#pragma once
// What formulas need of a number: a scalar, or on a CPU a vector of scalars (gs/simd.h) that holds a value of several
// Gaussians. A formula that chooses by ?: and combines truths by & and | serves both.
#include <cmath>
#include <cstdint>
#include <type_traits>

#include "gs/hd.h"
#include "gs/isa.h"

#ifndef __CUDACC__
#include "gs/simd.h"
#endif

// Of scalars, these truths are bools, for which clang would have && instead of &.
#ifdef __clang__
#if __has_warning("-Wbitwise-instead-of-logical")
#pragma clang diagnostic ignored "-Wbitwise-instead-of-logical"
#endif
#endif

GS_ISA_BEGIN

template <class V>
constexpr bool kIsScalar = std::is_floating_point_v<V>;

template <class V, bool kScalar = kIsScalar<V>>
struct NumberTypes {
  using Scalar = V;
  using Truth = bool;
  using Integer = int32_t;
};
#ifndef __CUDACC__
template <class V>
struct NumberTypes<V, false> {
  using Scalar = std::decay_t<decltype(V{}[0])>;
  using Lanes = Simd<Scalar, int(sizeof(V))>;
  using Truth = typename Lanes::Mask;
  using Integer = typename Lanes::Mask;
};
template <class V>
using LanesOf = typename NumberTypes<V>::Lanes;
#endif

template <class V>
using Scalar = typename NumberTypes<V>::Scalar;
template <class V>
using Truth = typename NumberTypes<V>::Truth;
template <class V>
using Integer = typename NumberTypes<V>::Integer;

GS_HD bool any(bool truth) { return truth; }

// The number whose lanes are all `value`.
template <class V>
GS_HD V all(double value) {
  return Scalar<V>(value) - V{};
}

template <class V>
GS_HD V larger(V a, V b) {
  return a < b ? b : a;
}

#ifdef __CUDACC__
#define GS_BY_LANES(scalar, lanes) return scalar;
#else
#define GS_BY_LANES(scalar, lanes) \
  if constexpr (kIsScalar<V>)      \
    return scalar;                 \
  else                             \
    return lanes;

template <class M>
bool any(M truth) {
  return Simd<std::conditional_t<sizeof(truth[0]) == 4, float, double>, int(sizeof(M))>::any(truth);
}
#endif

template <class V>
GS_HD V root(V x) {
  GS_BY_LANES(std::sqrt(x), LanesOf<V>::root(x))
}
template <class V>
GS_HD V magnitude(V x) {
  GS_BY_LANES(std::abs(x), LanesOf<V>::magnitude(x))
}
template <class V>
GS_HD V rounded_up(V x) {
  GS_BY_LANES(std::ceil(x), LanesOf<V>::rounded_up(x))
}
template <class V>
GS_HD Truth<V> is_finite(V x) {
  GS_BY_LANES(std::isfinite(x), x - x == V{})  // inf - inf is not a number
}
// Towards 0; x must fit.
template <class V>
GS_HD Integer<V> integer(V x) {
  GS_BY_LANES(Integer<V>(x), __builtin_convertvector(x, Integer<V>))
}
template <class V>
GS_HD V number(Integer<V> x){GS_BY_LANES(V(x), __builtin_convertvector(x, V))}

GS_ISA_END
