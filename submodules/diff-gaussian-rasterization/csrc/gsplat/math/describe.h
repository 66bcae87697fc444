#pragma once
// What programs for gsplat give and read: a camera as two matrices, and a splat as its covariance's inverse, its
// opacity, and its radii along x and y.
#include <cmath>

#include "gsplat/data.h"
#include "math/constants.h"
#include "math/splat.h"

GS_ISA_BEGIN

constexpr double kMostSigmas = 3.33;  // gsplat's bound of a radius

// What gsplat tests and tells of a splat: radii along x and y, px. They are 0 unless the box with these half sides
// around its mean meets the image. Programs count views by them, so they do not depend on whether a pixel's centre is
// reached.
template <class T>
struct Extent {
  T x, y;
  bool shown;  // also one that has tiles all the same: of an opacity of just 1/255, or of more than 1
};

template <class T>
GS_HD Splat<T> shape_of(const DescribeInput<T>& in, int64_t from) {
  Splat<T> s = {};
  T* const to[] = {&s.x, &s.y, &s.l11, &s.l12, &s.l22, &s.log2_opacity};
  s.log2_opacity = in.splats[in.row * from + kLog2Opacity];
  if (!(s.log2_opacity > T(2 * kLog2MinAlpha))) return s;  // of culled ones there is nothing else
  for (int k = 0; k < kLog2Opacity; ++k) *to[k] = in.splats[in.row * from + k];
  return s;
}

template <class T>
GS_HD Extent<T> extent_of(const DescribeInput<T>& in, int64_t from, const Splat<T>& s) {
  const bool listed = in.tile_counts[from] > 0;
  const T level = T(2 * kLn2) * (s.log2_opacity - T(kLog2MinAlpha));
  if (!(level > 0)) return {T(0), T(0), listed};
  const T sigmas = std::sqrt(level), reach = sigmas < T(kMostSigmas) ? sigmas : T(kMostSigmas), half = T(0.5);
  const T l11 = std::abs(s.l11), width = std::sqrt(T(kHalfLog2e)), wide = std::hypot(1 / l11, s.l12 / (l11 * s.l22));
  const T most = T(1 << 30), box_x = std::ceil(reach * (width * wide)), box_y = std::ceil(reach * (width / s.l22));
  const T x = box_x < most ? box_x : most, y = box_y < most ? box_y : most;
  const bool across = s.x + half + x > 0 && s.x + half - x < T(in.image.width);
  return {x, y, listed || (across && s.y + half + y > 0 && s.y + half - y < T(in.image.height))};
}

// Writes row i, zeros where the splat is not shown.
template <class T>
GS_HD void describe_splat(const DescribeInput<T>& in, const Descriptions<T>& out, int64_t i) {
  const int64_t from = in.rows ? in.rows[i] : i;
  Splat<T> s = shape_of(in, from);
  const Extent<T> extent = extent_of(in, from, s);
  const bool shown = extent.shown;
  if (!shown) s = {};
  const T l11 = std::abs(s.l11), half = T(0.5), per = T(1 / kHalfLog2e), depth = in.depths[from];
  out.radii[2 * i] = shown ? int32_t(extent.x) : 0;
  out.radii[2 * i + 1] = shown ? int32_t(extent.y) : 0;
  out.centers[2 * i] = shown ? s.x + half : T(0), out.centers[2 * i + 1] = shown ? s.y + half : T(0);
  // One without tiles has no depth for lists.
  out.depths[i] = !shown ? T(0) : depth < T(INFINITY) ? depth : 1 / in.splats[in.row * from + kInverseDepth];
  out.conics[3 * i] = per * (l11 * l11), out.conics[3 * i + 1] = per * (l11 * s.l12);
  out.conics[3 * i + 2] = per * (s.l12 * s.l12 + s.l22 * s.l22);
  out.opacities[i] = shown ? std::exp2(s.log2_opacity) : T(0);
  if (out.tiles) out.tiles[i] = in.tile_counts[from];
}

// What moments of the exponent (footprint.h) are as gradients of the description, with d = L^-1 (u, v) the way from the
// mean to a pixel: of the mean Q d, of the conic's entries -dx^2 / 2, -dx dy and -dy^2 / 2, each times q; of the
// opacity q over it.
template <class T>
GS_HD void describe_vjp_splat(const DescribedInput<T>& in, const DescribedGradient<T>& out, int64_t i) {
  T centers[2] = {}, conics[3] = {}, opacity = 0;
  const int64_t from = in.rows ? in.rows[i] : i;
  if (in.tile_counts[from] > 0) {
    const T *s = in.splats + in.row * from, *m = in.moments + in.row * from;
    const T l11 = std::abs(s[2]), l12 = s[3], l22 = s[4], two_ln2 = T(2 * kLn2);
    centers[0] = two_ln2 * l11 * m[1], centers[1] = two_ln2 * (l12 * m[1] + l22 * m[2]);
    const T yy = m[5] / l22 / l22, uy = m[4] / l22;
    conics[0] = T(-0.5) * ((m[3] - 2 * l12 * uy + l12 * l12 * yy) / l11 / l11);
    conics[1] = -(uy - l12 * yy) / l11, conics[2] = T(-0.5) * yy;
    opacity = m[0] * std::exp2(-s[5]);
  }
  for (int k = 0; k < 2; ++k) out.centers[2 * i + k] = centers[k];
  for (int k = 0; k < 3; ++k) out.conics[3 * i + k] = conics[k];
  out.opacities[i] = opacity;
}

// The view and the full projection of make_camera (camera.h), and the centre, from a matrix of the world's view (4, 4)
// and one of intrinsics (3, 3), of which four numbers count. The last row of the view is that of any pose.
template <class T>
GS_HD void make_pinhole(const T* pose, const T* K, Image image, const PinholeMatrices<T>& out) {
  const double entries[2] = {2.0 * K[0] / image.width, 2.0 * K[4] / image.height};
  const double shift[2] = {2.0 * K[2] / image.width - 1, 2.0 * K[5] / image.height - 1};
  double rows[3][4];
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 4; ++c) rows[r][c] = double(pose[4 * r + c]), out.view[4 * c + r] = pose[4 * r + c];
  for (int c = 0; c < 4; ++c) {
    out.view[4 * c + 3] = T(c == 3);
    for (int r = 0; r < 2; ++r) out.full[4 * c + r] = T(entries[r] * rows[r][c] + shift[r] * rows[2][c]);
    out.full[4 * c + 2] = out.full[4 * c + 3] = T(rows[2][c]);
  }
  const auto row = [&](int r) { return Vec3<double>{rows[r][0], rows[r][1], rows[r][2]}; };
  const Vec3<double> dual_x = cross(row(1), row(2)), dual_y = cross(row(2), row(0)), dual_z = cross(row(0), row(1));
  const Vec3<double> away = rows[0][3] * dual_x + rows[1][3] * dual_y + rows[2][3] * dual_z;
  const double scale = -1 / dot(row(0), dual_x);
  out.center[0] = T(scale * away.x), out.center[1] = T(scale * away.y), out.center[2] = T(scale * away.z);
}

GS_ISA_END
