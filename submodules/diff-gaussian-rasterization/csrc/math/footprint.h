#pragma once
// A splat's footprint on the image plane: from M (2x3, rows m1, m2; covariance M M^T + dilation) to the factor of the
// conic, and the derivative.
#include "camera.h"

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
  Truth<T> floored;
  Dilation<Scalar<T>> dilation;
};

// det = |m1 x m2|^2 + h (|m1|^2 + |m2|^2) + h^2 (Cauchy-Binet) has only non-negative terms, so nothing cancels. All is
// divided by c, so that nothing overflows. With S = log2(e)/2 covariance^-1 = L^T L:
// l22 = sqrt(k/c), l11 = sqrt(k c/det), l12 = -(b/c) l11.
template <class T>
GS_HD Footprint<T> make_footprint(Vec3<T> m1, Vec3<T> m2, Vec3<T> minors, Dilation<Scalar<T>> dilation) {
  const Scalar<T> h = dilation.area, k = Scalar<T>(kHalfLog2e);
  Footprint<T> f;
  f.m1 = m1, f.m2 = m2, f.minors = minors, f.dilation = dilation;
  f.a0 = dot(m1, m1), f.c0 = dot(m2, m2);
  f.a = f.a0 + h, f.b = dot(m1, m2), f.c = f.c0 + h;
  const T width = root(f.c);
  const Vec3<T> n = {minors.x / width, minors.y / width, minors.z / width};
  const T det0 = dot(n, n);
  f.excess = h * ((f.a0 + f.c0 + h) / f.c);
  f.schur = det0 + f.excess;
  f.l22 = root(k / f.c);
  f.l11 = root(k / f.schur);
  f.l12 = -(f.b / f.c) * f.l11;
  const T ratio = det0 / f.schur;
  f.floored = !(ratio > dilation.floor);
  f.compensation = root(f.floored ? all<T>(dilation.floor) : ratio);
  return f;
}

// Sums over a splat's pixels, in its whitened coordinates (u, v): q = uncapped alpha times dLoss/dalpha.
template <class T>
struct Moments {
  T q, qu, qv, quu, quv, qvv;
};

// d log2(alpha)/dmean = 2 L^T w, w = (u, v).
template <class T>
GS_HD void mean_vjp(const Footprint<T>& f, const Moments<T>& s, T& gx, T& gy) {
  const Scalar<T> two_ln2 = Scalar<T>(2 * kLn2);
  gx = two_ln2 * f.l11 * s.qu;
  gy = two_ln2 * (f.l12 * s.qu + f.l22 * s.qv);
}

// det/det0 - 1 where the compensation is not floored.
template <class T>
GS_HD T compensation_excess(const Footprint<T>& f) {
  return f.excess / (f.compensation * f.compensation * f.schur);
}

// The gradient of M by rows, and in the splat's own frame the symmetric matrix M^T dM. Scales and rotation come from
// that matrix, so that nothing cancels between an axis' length and its direction.
template <class T>
struct ShapeGradient {
  Vec3<T> m1, m2;
  Vec3<T> diagonal, off;  // xx yy zz, yz zx xy
};

// The rows of L M. The first is l11 (m1 - (b/c) m2) = l11 (m2 x (m1 x m2) + h m1) / c, without the cancellation.
template <class T>
GS_HD void whitened_rows(const Footprint<T>& f, Vec3<T>& u, Vec3<T>& v) {
  const T part = 1 / root(f.c);  // scales both factors, because their product overflows
  u = f.l11 * (cross(part * f.m2, part * f.minors) + (f.dilation.area / f.c) * f.m1), v = f.l22 * f.m2;
}

// W is 4 ln2^2 W2, W2 the second moments. With antialiasing the opacity carries sqrt(det0/det), which adds
// L^-T (adj0/det0 - adj/det) L^-1, adj0 and adj the adjugates of the covariance before and after dilation. Multiplied
// out with det0 = a0 c0 - b^2, its terms in b and c cancel on paper.
template <class T>
GS_HD void second_moments(const Footprint<T>& f, const Moments<T>& s, bool antialiasing, T& uu, T& uv, T& vv) {
  const Scalar<T> h = f.dilation.area, four_ln2_sq = Scalar<T>(4 * kLn2 * kLn2);
  uu = four_ln2_sq * s.quu, uv = four_ln2_sq * s.quv, vv = four_ln2_sq * s.qvv;
  if (antialiasing && any(!f.floored)) {
    const T inverse_ratio = 1 / (f.compensation * f.compensation), slope = f.b / f.c;
    const T k = f.dilation.exponents * s.q * inverse_ratio;
    uu = f.floored ? uu : uu + k * ((slope / f.schur) * slope + f.c0 / f.c / f.schur);
    uv = f.floored ? uv : uv - k * (slope / root(f.schur) / root(f.c));
    vv = f.floored ? vv : vv + k * ((f.compensation * f.compensation + h * (f.a0 / f.c / f.schur)) / f.c);
  }
}

// dM = L^T W (L M): covariance's gradient is L^T W L / 2, and covariance = M M^T + const. So M^T dM = (L M)^T W (L M).
template <class T>
GS_HD ShapeGradient<T> footprint_vjp(const Footprint<T>& f, const Moments<T>& s, bool antialiasing) {
  T uu, uv, vv;
  second_moments(f, s, antialiasing, uu, uv, vv);
  Vec3<T> lm_u, lm_v;
  whitened_rows(f, lm_u, lm_v);
  const Vec3<T> wu = uu * lm_u + uv * lm_v, wv = uv * lm_u + vv * lm_v;
  return {f.l11 * wu,
          f.l12 * wu + f.l22 * wv,
          {lm_u.x * wu.x + lm_v.x * wv.x, lm_u.y * wu.y + lm_v.y * wv.y, lm_u.z * wu.z + lm_v.z * wv.z},
          {lm_u.y * wu.z + lm_v.y * wv.z, lm_u.z * wu.x + lm_v.z * wv.x, lm_u.x * wu.y + lm_v.x * wv.y}};
}

// The gradient of the 2D covariance (xx, xy, yy; xy once, of the symmetric matrix), for Gaussians given by cov3d.
template <class T>
GS_HD void covariance2d_vjp(const Footprint<T>& f, const Moments<T>& s, bool antialiasing, T g[3]) {
  const Scalar<T> two_ln2_sq = Scalar<T>(2 * kLn2 * kLn2);
  const T uu = s.quu * f.l11, uv = s.quv * f.l11;
  const T vu = s.quu * f.l12 + s.quv * f.l22, vv = s.quv * f.l12 + s.qvv * f.l22;
  g[0] = two_ln2_sq * f.l11 * uu;
  g[1] = two_ln2_sq * (f.l12 * uu + f.l22 * uv);
  g[2] = two_ln2_sq * (f.l12 * vu + f.l22 * vv);
  if (!antialiasing || !any(!f.floored)) return;
  const Scalar<T> h = f.dilation.area;
  const T excess = compensation_excess(f), half_per_det = Scalar<T>(0.5) * s.q / f.schur / f.c;
  g[0] = f.floored ? g[0] : g[0] + half_per_det * (excess * f.c0 - h);
  g[1] = f.floored ? g[1] : g[1] - half_per_det * (excess * f.b);
  g[2] = f.floored ? g[2] : g[2] + half_per_det * (excess * f.a0 - h);
}

// ceil(3 sigma) of the larger axis, the reference's rule; at most 2^30.
template <class T>
GS_HD Integer<T> footprint_radius(const Footprint<T>& f) {
  const Scalar<T> half = Scalar<T>(0.5);
  const T apart = larger(root(all<T>(kMinRadiusRoot)), length<T>(half * (f.a - f.c), f.b));
  const T radius = rounded_up(Scalar<T>(kRadiusSigmas) * root(half * (f.a + f.c) + apart));
  return integer(radius < Scalar<T>(1 << 30) ? radius : all<T>(1 << 30));
}

GS_ISA_END
