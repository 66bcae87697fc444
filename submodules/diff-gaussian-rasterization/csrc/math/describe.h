#pragma once
// A splat as programs for gsplat know it: its covariance's inverse, its opacity, and its radii along x and y.
#include <cmath>

#include "../data.h"
#include "constants.h"
#include "splat.h"

GS_ISA_BEGIN

constexpr double kMostSigmas = 3.33;  // gsplat's bound of a radius

// Writes row i, zeros where the splat has no tile.
template <class T>
GS_HD void describe_splat(const DescribeInput<T>& in, const Descriptions<T>& out, int64_t i) {
  Splat<T> s = {};
  const bool shown = in.tile_counts[i] > 0;
  if (shown) {
    T* const to[] = {&s.x, &s.y, &s.l11, &s.l12, &s.l22, &s.log2_opacity};
    for (int k = 0; k < 6; ++k) *to[k] = in.splats[in.row * i + k];
  }
  const T l11 = std::abs(s.l11), half = T(0.5), per = T(1 / kHalfLog2e);
  const T level = T(2 * kLn2) * (s.log2_opacity - T(kLog2MinAlpha));
  const T sigmas = level > 0 ? std::sqrt(level) : T(0), reach = sigmas < T(kMostSigmas) ? sigmas : T(kMostSigmas);
  const T width = std::sqrt(T(kHalfLog2e)), along = s.l12 / (l11 * s.l22), wide = std::hypot(1 / l11, along);
  out.radii[2 * i] = shown ? int32_t(std::ceil(reach * (width * wide))) : 0;
  out.radii[2 * i + 1] = shown ? int32_t(std::ceil(reach * (width / s.l22))) : 0;
  out.centers[2 * i] = shown ? s.x + half : T(0), out.centers[2 * i + 1] = shown ? s.y + half : T(0);
  out.depths[i] = shown ? in.depths[i] : T(0);
  out.conics[3 * i] = per * (l11 * l11), out.conics[3 * i + 1] = per * (l11 * s.l12);
  out.conics[3 * i + 2] = per * (s.l12 * s.l12 + s.l22 * s.l22);
  out.opacities[i] = shown ? std::exp2(s.log2_opacity) : T(0);
}

GS_ISA_END
