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

// u is computed in double: far along a needle it is the small difference of two products in the thousands.
template <class T>
GS_HD LocalSplat<T> localise(const Splat<T>& s, T origin_x, T origin_y) {
  const double dx = origin_x + kTileCentre - s.x, dy = origin_y + kTileCentre - s.y;
  const T u = T(multiply_add(double(s.l12), dy, s.l11 * dx));
  return {s.y - origin_y, s.l11, s.l12, s.l22, u, s.log2_opacity, s.r, s.g, s.b, s.inverse_depth};
}

// Along a row of pixels v is constant: log2(alpha) = top - u^2, u = u0 + l11 (x - centre).
template <class T>
struct RowTerms {
  T top, l11, u0, v;
};

template <class T>
GS_HD RowTerms<T> row_terms(const LocalSplat<T>& s, T y) {
  const T v = s.l22 * (y - s.y);
  return {s.log2_opacity - v * v, s.l11, s.l12 * (y - T(kTileCentre)) + s.u, v};
}

template <class V, class T>
GS_HD V row_u(const RowTerms<T>& row, V x) {
  return (x - T(kTileCentre)) * row.l11 + row.u0;
}
template <class V, class T>
GS_HD V row_exponent(const RowTerms<T>& row, V u) {
  return row.top - u * u;
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
template <class T, class V>
GS_HD V alpha_gradient(V alpha, V s, V& transmittance, V& behind) {
  transmittance = quotient(transmittance, T(1) - alpha);
  const V difference = s - behind;
  behind = behind + alpha * difference;
  return transmittance * difference;
}

GS_ISA_END
