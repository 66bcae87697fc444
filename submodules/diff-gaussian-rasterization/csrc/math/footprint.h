#pragma once
// The splat on the image plane: from M (2x3, rows m1, m2; covariance M M^T + dilation) to the factor of the
// conic, and back.
#include "constants.h"
#include "vec.h"

GS_ISA_BEGIN

// exponent(d) = -(u^2 + v^2) in log2 units, u = l11 dx + l12 dy, v = l22 dy, d = pixel - mean.
template <class T>
struct Footprint {
  Vec3<T> m1, m2;
  Vec3<T> minors;  // m1 x m2, the 2x2 minors of M
  T a0, c0;        // covariance xx, yy
  T a, b, c;       // dilated covariance xx, xy, yy
  T schur;         // det / c
  T excess;        // (det - det undilated) / c
  T l11, l12, l22;
  T compensation;  // sqrt(det undilated / det), floored: the antialiasing factor
  bool floored;
};

// det = |m1 x m2|^2 + h (|m1|^2 + |m2|^2) + h^2 (Cauchy-Binet): only non-negative terms, so nothing cancels, and
// divided by c throughout, so that it does not overflow either. With S = log2(e)/2 covariance^-1 = L^T L:
// l22 = sqrt(k/c), l11 = sqrt(k c/det), l12 = -(b/c) l11.
template <class T>
GS_HD Footprint<T> make_footprint(Vec3<T> m1, Vec3<T> m2, Vec3<T> minors) {
  const T h = T(kDilation), k = T(kHalfLog2e);
  Footprint<T> f;
  f.m1 = m1, f.m2 = m2, f.minors = minors;
  f.a0 = dot(m1, m1), f.c0 = dot(m2, m2);
  f.a = f.a0 + h, f.b = dot(m1, m2), f.c = f.c0 + h;
  const T root = std::sqrt(f.c);
  const Vec3<T> n = {minors.x / root, minors.y / root, minors.z / root};
  const T det0 = dot(n, n);
  f.excess = h * ((f.a0 + f.c0 + h) / f.c);
  f.schur = det0 + f.excess;
  f.l22 = std::sqrt(k / f.c);
  f.l11 = std::sqrt(k / f.schur);
  f.l12 = -(f.b / f.c) * f.l11;
  const T ratio = det0 / f.schur;
  f.floored = !(ratio > T(kMinAntialias));
  f.compensation = std::sqrt(f.floored ? T(kMinAntialias) : ratio);
  return f;
}

// Sums over pixels, whitened: q = alpha uncapped times dLoss/dalpha.
template <class T>
struct Moments {
  T q, qu, qv, quu, quv, qvv;
};

// d log2(alpha)/dmean = 2 L^T w, w = (u, v).
template <class T>
GS_HD void mean_vjp(const Footprint<T>& f, const Moments<T>& s, T& gx, T& gy) {
  const T two_ln2 = T(2 * kLn2);
  gx = two_ln2 * f.l11 * s.qu;
  gy = two_ln2 * (f.l12 * s.qu + f.l22 * s.qv);
}

// det/det0 - 1, where the compensation is not floored.
template <class T>
GS_HD T compensation_excess(const Footprint<T>& f) {
  return f.excess / (f.compensation * f.compensation * f.schur);
}

// dM = 4 ln2^2 L^T W2 (L M): covariance's gradient is 2 ln2^2 L^T W2 L, and covariance = M M^T + const.
// The first row of L M is l11 (m1 - (b/c) m2) = l11 (m2 x (m1 x m2) + h m1) / c, without the cancellation.
// With antialiasing the opacity carries sqrt(det0/det): d ln = (ddet0/det0 - ddet/det)/2,
// ddet0/dm1 = 2 m2 x (m1 x m2), ddet0/dm2 = 2 (m1 x m2) x m1, ddet = ddet0 + 2 h dM; 1/det0 - 1/det is taken as
// excess / (det0 det), since the two are equal but for rounding where the splat is large.
template <class T>
GS_HD void footprint_vjp(const Footprint<T>& f, const Moments<T>& s, bool antialiasing, Vec3<T>& g1, Vec3<T>& g2) {
  const T h = T(kDilation), four_ln2_sq = T(4 * kLn2 * kLn2);
  const T root = 1 / std::sqrt(f.c);                       // both factors by this: the product overflows
  const Vec3<T> d1 = cross(root * f.m2, root * f.minors);  // half of ddet0/dm1, over c
  const Vec3<T> lm_u = f.l11 * (d1 + (h / f.c) * f.m1), lm_v = f.l22 * f.m2;
  const Vec3<T> wu = s.quu * lm_u + s.quv * lm_v, wv = s.quv * lm_u + s.qvv * lm_v;
  g1 = (four_ln2_sq * f.l11) * wu;
  g2 = four_ln2_sq * (f.l12 * wu + f.l22 * wv);
  if (!antialiasing || f.floored) return;
  const Vec3<T> d2 = cross(root * f.minors, root * f.m1);
  const T per_det = s.q / f.schur, difference = per_det * compensation_excess(f), dilation = per_det * h / f.c;
  g1 = g1 + difference * d1 - dilation * f.m1;
  g2 = g2 + difference * d2 - dilation * f.m2;
}

// Gradient of the 2D covariance (xx, xy, yy; xy once, of the symmetric matrix), for covariances that were given.
template <class T>
GS_HD void covariance2d_vjp(const Footprint<T>& f, const Moments<T>& s, bool antialiasing, T g[3]) {
  const T two_ln2_sq = T(2 * kLn2 * kLn2);
  const T uu = s.quu * f.l11, uv = s.quv * f.l11;
  const T vu = s.quu * f.l12 + s.quv * f.l22, vv = s.quv * f.l12 + s.qvv * f.l22;
  g[0] = two_ln2_sq * f.l11 * uu;
  g[1] = two_ln2_sq * (f.l12 * uu + f.l22 * uv);
  g[2] = two_ln2_sq * (f.l12 * vu + f.l22 * vv);
  if (!antialiasing || f.floored) return;
  const T h = T(kDilation), excess = compensation_excess(f), half_per_det = T(0.5) * s.q / f.schur / f.c;
  g[0] += half_per_det * (excess * f.c0 - h);
  g[1] -= half_per_det * (excess * f.b);
  g[2] += half_per_det * (excess * f.a0 - h);
}

// ceil(3 sigma) of the larger axis, the reference's rule; at most 2^30.
template <class T>
GS_HD int footprint_radius(const Footprint<T>& f) {
  const T root = larger(std::sqrt(T(kMinRadiusRoot)), length(T(0.5) * (f.a - f.c), f.b));
  const T radius = std::ceil(T(kRadiusSigmas) * std::sqrt(T(0.5) * (f.a + f.c) + root));
  return radius < T(1 << 30) ? int(radius) : 1 << 30;
}

GS_ISA_END
