#pragma once
// A splat, a Gaussian projected to the image, and the number of values in its rows.
#include <type_traits>

#include "../data.h"
#include "vec.h"

GS_ISA_BEGIN

// A row of the tensor `splats`: all that blending needs.
template <class T>
struct Splat {
  T x, y;           // mean, px, pixel centres at integers
  T l11, l12, l22;  // factor of the conic, log2 units (footprint.h); l11 is negative if the splat crosses a border
  T log2_opacity;   // antialiasing included
  T r, g, b;
  T inverse_depth;  // 1 / view z
};
constexpr int kSplatValues = 10, kLog2Opacity = 5, kInverseDepth = 9;

// The left border of a tile, as seen from a splat. A splat that crosses a border of a panorama goes on at the other
// one: it has a copy every `width` of the image, and a tile shows the nearest one.
template <class T, class V>
GS_HD V unrolled(const Splat<T>& s, V left, int width) {
  if (!(s.l11 < 0)) return left;
  const T period = T(width), half = period / 2;
  const V away = left - s.x;
  return away < -half ? left + period : away >= half ? left - period : left;
}

// Gradient sums of a splat over its pixels: moments of the exponent (footprint.h), then colour and inverse depth.
constexpr int kGradientValues = 10;  // q, qu, qv, quu, quv, qvv, r, g, b, inverse depth
constexpr int kColorMoment = 6;      // where r, g, b begin

// A splat of which a pixel sees what is on its ray (ray.h).
template <class T>
struct RaySplat : Splat<T> {
  T slope_u, slope_v;
  T e;     // log2 units
  T none;  // 0: a GPU moves values in pairs
};
constexpr int kRayValues = 4;  // of a row besides, and of its gradient sums, of which the last is 0 as well
static_assert(sizeof(RaySplat<float>) == (kSplatValues + kRayValues) * sizeof(float), "a row of splats");

// The same of a lens (lens_rays.h). x, y: the mean's pixel, or of the nearest point of the lens's field.
template <class T>
struct LensRaySplat : RaySplat<T> {
  Vec3<T> to_u, to_v, n;  // factors of a direction of the view
  T nothing;
};
constexpr int kLensRayValues = 10;  // of a row besides
static_assert(sizeof(LensRaySplat<float>) == (kSplatValues + kRayValues + kLensRayValues) * sizeof(float), "the same");

template <class T, int kRays>
using SplatOf = std::conditional_t<kRays == kLensRays, LensRaySplat<T>,
                                   std::conditional_t<kRays == kNoRays, Splat<T>, RaySplat<T>>>;
GS_HD constexpr int splat_row(int rays) {
  return kSplatValues + (rays ? kRayValues : 0) + (rays == kLensRays ? kLensRayValues : 0);
}
GS_HD constexpr int gradient_row(int rays) { return kGradientValues + (rays ? kRayValues : 0); }
template <int kRays>
constexpr int kSplatRow = splat_row(kRays);
template <int kRays>
constexpr int kGradientRow = gradient_row(kRays);

GS_ISA_END
