#pragma once
// Blending at a pixel. V is a lane type (a scalar, or a vector type of the compiler), T its scalar.
#include "constants.h"
#include "gs/hd.h"
#include "splat.h"
#include "vec.h"

GS_ISA_BEGIN

// A splat in coordinates local to a tile. In image coordinates, small splats lose 1.3e-3 of the exponent; in these they
// lose 1.1e-5. Products are arranged so that a compiler can fuse them in one way only: forward and backward must agree
// on which pixels are reached.
template <class T>
struct LocalSplat {
  T y, l11, l12, l22;
  T u;  // at the tile's centre
  T log2_opacity;
  T r, g, b, inverse_depth;
};

constexpr double kTileCentre = (kTile - 1) / 2.0;

// left: as `unrolled` gives it. u is computed in double: far along a needle it is the small difference of two products
// in the thousands.
template <class T>
GS_HD LocalSplat<T> localise(const Splat<T>& s, T left, T top) {
  const double dx = left + kTileCentre - s.x, dy = top + kTileCentre - s.y;
  const T l11 = magnitude(s.l11), u = T(multiply_add(double(s.l12), dy, l11 * dx));
  return {s.y - top, l11, s.l12, s.l22, u, s.log2_opacity, s.r, s.g, s.b, s.inverse_depth};
}

// Along a row of pixels v is constant: log2(alpha) = top - u^2, u = u0 + l11 (x - centre).
template <class T>
struct RowTerms {
  T top, l11, u0, v;
};

// V may be a vector of splats in one row y, or of one splat in rows y.
template <class V, class Y>
GS_HD RowTerms<V> row_terms(const LocalSplat<V>& s, Y y) {
  const V v = s.l22 * (y - s.y);
  // Fused by name: where v * v is also used by itself, a compiler would round it first, and a backward would have other
  // exponents than its forward.
  return {multiply_add(-v, v, s.log2_opacity), s.l11, s.l12 * (y - float(kTileCentre)) + s.u, v};
}

// T: V or its scalar.
template <class V, class T>
GS_HD V row_u(const RowTerms<T>& row, V x) {
  const V along = x - Scalar<V>(kTileCentre);
  if constexpr (kIsScalar<V>)
    return along * row.l11 + row.u0;
  else  // fused by name: where l11 is constant in a loop, a compiler would hoist the product and round it
    return multiply_add(along, row.l11 - V{}, row.u0 - V{});
}
template <class V, class T>
GS_HD V row_exponent(const RowTerms<T>& row, V u) {
  return row.top - u * u;
}

// Whether a splat may reach a pixel from `first` to `last` of a row; V may be a vector of splats or of rows. In
// between, u takes all values between those at the ends. Its least magnitude is rounded down by 60 units in the last
// place of its terms, so this never denies a pixel that row_exponent reaches, in whatever way u is rounded.
template <class V, class T>
GS_HD auto row_reached(const RowTerms<V>& row, T first, T last) {
  const T half = (last - first) / 2, centre = (last + first) / 2 - T(kTileCentre), margin = T(4e-6);
  const V u = row.l11 * centre + row.u0, slope = larger(row.l11, V(-row.l11)), start = larger(row.u0, V(-row.u0));
  const V least = larger(u, V(-u)) - (slope * (half + margin * T(kTileCentre)) + start * margin);
  return row_exponent(row, larger(least, V{})) >= T(kLog2MinAlpha);
}

template <class V, class T>
GS_HD V capped(V alpha, T cap = T(kMaxAlpha)) {
  return alpha < cap ? alpha : V{} + cap;
}

// a / b. A GPU uses the hardware's reciprocal and a correction step. Without the correction a division is 2e-8 off on
// average, and 2,000 of them in a row are 4e-5 off.
template <class V>
GS_HD V quotient(V a, V b) {
#ifdef __CUDA_ARCH__
  const V inverse = __fdividef(V(1), b), first = a * inverse;
  return std::fma(std::fma(-first, b, a), inverse, first);
#else
  return a / b;
#endif
}

// dLoss/dalpha, walking back to front with one scalar for the colour: s = colour . image gradient of this splat, and
// `behind` the normalised value of everything behind it. dLoss/dalpha = T (s - behind), T the transmittance in front of
// the splat. transmittance holds T (1 - alpha) on entry and T on return. Nothing is subtracted from a stored colour.
// Lanes that are not reached have an alpha of 0, and take no part even where s or `behind` is not finite.
template <class T, class V>
GS_HD V alpha_gradient(Truth<V> reached, V alpha, V s, V& transmittance, V& behind) {
  transmittance = quotient(transmittance, T(1) - alpha);
  const V difference = reached ? s - behind : V{};
  behind = behind + alpha * difference;
  return transmittance * difference;
}

GS_ISA_END
