#pragma once
// Gaussians on rays (Huang et al. 2026, 3DGEER): a pixel's alpha is that of its own ray, without EWA's affine map. On a
// ray a Gaussian is at most exp(-D^2 / 2), D the ray's Mahalanobis distance from the mean.
//
// Write points as (x, y) px and the logarithm of depth, linear around the mean. With the rows m1, m2 of M = J W R S and
// m3 that of the logarithm, the covariance there is ((C, k), (k, c)): C = (m1, m2) (m1, m2)^T + dilation, k = (m1 m3,
// m2 m3), c = m3 m3. A pinhole's ray has there the direction (d, 1), d = pixel - mean. With whitened d, (u, v) = L d,
//   D^2 = q / (s^2 + e q),   q = u^2 + v^2,   s = 1 + slope (u, v),
// slope = -2 ln2 L k, and e = c - k C^-1 k, what m1 and m2 do not explain of c, over log2(e)/2. q is EWA's exponent,
// and s > 0 says that the largest value lies in front of the camera. Nothing is divided by a scale, so that flat
// Gaussians are nothing special. Around the camera e is large, and D^2 never exceeds 1 / e.
#include "projection.h"

GS_ISA_BEGIN

// A pinhole whose Gaussians are seen on rays.
template <class T>
struct RayCamera : Camera<T> {};

template <class AnyCamera>
constexpr int kOnRays = kNoRays;
template <class T>
constexpr int kOnRays<RayCamera<T>> = kPinholeRays;

// Of no clamped ray: nothing here explodes.
template <class T, class V>
GS_HD Perspective<V> perspective(const RayCamera<T>& cam, Vec3<V> view) {
  Perspective<V> p;
  p.inverse_depth = 1 / view.z;
  p.ray_x = p.clamped_x = view.x * p.inverse_depth, p.ray_y = p.clamped_y = view.y * p.inverse_depth;
  p.p1 = (cam.focal_x * p.inverse_depth) * (cam.row_x - p.ray_x * cam.row_z);
  p.p2 = (cam.focal_y * p.inverse_depth) * (cam.row_y - p.ray_y * cam.row_z);
  return p;
}

template <class T>
struct Slopes {
  T slope_u, slope_v, e;
  Vec3<T> lm_u, lm_v;  // rows of L M
  Vec3<T> rest;        // of m3, which they do not explain
};

// e = det ((C, k), (k, c)) / det C has only non-negative terms, by Cauchy and Binet:
// ((m1 x m2) m3)^2 + h (|m1 x m3|^2 + |m2 x m3|^2) + h^2 |m3|^2 over c schur.
template <class T>
GS_HD Slopes<T> make_slopes(const Footprint<T>& f, Vec3<T> m3) {
  const Scalar<T> h = f.dilation.area, two_ln2 = Scalar<T>(2 * kLn2);
  Slopes<T> s;
  whitened_rows(f, s.lm_u, s.lm_v);
  s.slope_u = -two_ln2 * dot(s.lm_u, m3), s.slope_v = -two_ln2 * dot(s.lm_v, m3);
  s.rest = m3 + s.slope_u * s.lm_u + s.slope_v * s.lm_v;
  const T per = 1 / root(f.c) / root(f.schur);  // scales factors, because their product overflows
  const T volume = dot(per * f.minors, m3);
  const Vec3<T> across = cross(per * f.m1, m3), down = cross(per * f.m2, m3), dilated = (h * per) * m3;
  s.e = two_ln2 * (volume * volume + h * (dot(across, across) + dot(down, down)) + dot(dilated, dilated));
  return s;
}

// As for EWA, by whose clamped footprint radii count.
template <class T, class V>
GS_HD Truth<V> project_splat(const RayCamera<T>& cam, const Gaussian<V>& gaussian, bool antialiasing,
                             RaySplat<V>& splat, V& depth, Integer<V>& radius) {
  const Camera<T>& flat = cam;
  Splat<V>& on_image = splat;
  Truth<V> visible = project_splat(flat, gaussian, false, on_image, depth, radius);
  if (!any(visible)) return visible;
  const Perspective<V> p = perspective(cam, to_view(cam, gaussian.mean));
  const Footprint<V> f = splat_footprint(cam, p, gaussian.axes);
  const Slopes<V> s = make_slopes(f, row_of(p.inverse_depth * cam.row_z, gaussian.axes));
  splat.l11 = f.l11, splat.l12 = f.l12, splat.l22 = f.l22;
  splat.slope_u = s.slope_u, splat.slope_v = s.slope_v, splat.e = s.e;
  if (antialiasing) splat.log2_opacity += binary_log(f.compensation);
  visible &= is_finite(f.l12) & (f.l11 > 0) & (f.l22 > 0) & (f.a + f.c < T(kMaxVariance));
  return visible & is_finite(s.slope_u) & is_finite(s.slope_v) & is_finite(s.e) &
         (splat.log2_opacity >= T(kLog2MinAlpha) - T(1e-3));
}

// As for EWA, and of no tile on rays: a ball of the largest scale, with the dilation, lies beyond a plane through the
// camera and a border of the image. Over the mean's depth, px: its distance along the image, and 3.5 deviations of
// that.
template <class T, class V, class Scale>
GS_HD Truth<V> surely_outside(const RayCamera<T>& cam, Vec3<V> mean, const Scale& largest_scale) {
  const Camera<T>& flat = cam;
  const Vec3<V> view = to_view(cam, mean);
  const Truth<V> out = surely_outside(flat, mean, largest_scale), front = in_front(cam, view.z), off = out & front;
  if (!any(off)) return out;
  const V per_depth = 1 / view.z, scale = largest_scale();
  Truth<V> beyond = !front;
  const auto test = [&](V at, T sign, T border, T focal, T axis, Vec3<T> row) {
    const Vec3<T> normal = focal * row - (border - axis) * cam.row_z;
    const V away = (sign * (focal * at * per_depth + axis - border) - 3) / T(3.5), wide = scale * per_depth;
    beyond |= (away > 0) & (wide * wide * dot(normal, normal) + 1 < away * away);
  };
  test(view.x, -1, T(-1), cam.mean_focal_x, cam.axis_x, cam.row_x);
  test(view.x, 1, T(cam.width), cam.mean_focal_x, cam.axis_x, cam.row_x);
  test(view.y, -1, T(-1), cam.mean_focal_y, cam.axis_y, cam.row_y);
  test(view.y, 1, T(cam.height), cam.mean_focal_y, cam.axis_y, cam.row_y);
  return out & beyond;
}

// Sums over a splat's pixels, with x = (u, v) / s, p = q / s^2, a = x - slope p, and w = 1 / (1 + e p)^2, which is the
// derivative of D^2 by p. Its derivative by the mean's pixel is -2 L^T w a / s.
template <class T>
struct RayMoments {
  Moments<T> on_image;  // of 1, w a / s, and w x x^T
  T pu, pv, pp;         // of w p x and w p^2
};

// Of M with the third row m3. D^2 changes by -2 n dM y, with n = (L^T a, -p) and y = (L M)^T x - p rest, the point of
// the ray next to the mean, whitened in the Gaussian's own frame. So dM = 4 ln2^2 sum w n y, and M^T dM = 4 ln2^2 sum
// w y y. In a and m3 these cancel where a needle comes towards the camera; in x and rest nothing does.
template <class T>
GS_HD ShapeGradient<T> ray_vjp(const Footprint<T>& f, const RayMoments<T>& m, const Slopes<T>& s, bool antialiasing,
                               Vec3<T>& m3) {
  const Scalar<T> four_ln2_sq = Scalar<T>(4 * kLn2 * kLn2);
  T uu, uv, vv;
  second_moments(f, m.on_image, antialiasing, uu, uv, vv);
  const T pu = four_ln2_sq * m.pu, pv = four_ln2_sq * m.pv, pp = four_ln2_sq * m.pp;
  const Vec3<T>&u = s.lm_u, &v = s.lm_v, &r = s.rest;
  const Vec3<T> yu = uu * u + uv * v - pu * r, yv = uv * u + vv * v - pv * r, yp = pu * u + pv * v - pp * r;
  const Vec3<T> au = yu - s.slope_u * yp, av = yv - s.slope_v * yp;
  m3 = Scalar<T>(-1) * yp;
  return {f.l11 * au,
          f.l12 * au + f.l22 * av,
          {u.x * yu.x + v.x * yv.x - r.x * yp.x, u.y * yu.y + v.y * yv.y - r.y * yp.y,
           u.z * yu.z + v.z * yv.z - r.z * yp.z},
          {u.y * yu.z + v.y * yv.z - r.y * yp.z, u.z * yu.x + v.z * yv.x - r.z * yp.x,
           u.x * yu.y + v.x * yv.y - r.x * yp.y}};
}

// The moments of a, for the gradient of C, and that of k.
template <class T>
GS_HD Moments<T> pulling_moments(const Footprint<T>& f, const RayMoments<T>& m, const Slopes<T>& s, T k[2]) {
  const T su = s.slope_u, sv = s.slope_v;
  Moments<T> a = m.on_image;
  a.quu += su * (su * m.pp - 2 * m.pu), a.qvv += sv * (sv * m.pp - 2 * m.pv);
  a.quv += su * (sv * m.pp - m.pv) - sv * m.pu;
  const Scalar<T> four_ln2_sq = Scalar<T>(4 * kLn2 * kLn2);
  const T u = four_ln2_sq * (su * m.pp - m.pu), v = four_ln2_sq * (sv * m.pp - m.pv);
  k[0] = f.l11 * u, k[1] = f.l12 * u + f.l22 * v;
  return a;
}

// For Gaussians given by cov3d, p3 the row that makes m3: the gradients of C by the moments of a, of k and of c.
template <class T>
GS_HD void ray_covariance_vjp(const Footprint<T>& f, const RayMoments<T>& m, const Slopes<T>& s, bool antialiasing,
                              Vec3<T> p1, Vec3<T> p2, Vec3<T> p3, T* g) {
  T c2[3], k[2], more[6];
  covariance2d_vjp(f, pulling_moments(f, m, s, k), antialiasing, c2);
  covariance_vjp(p1, p2, c2, g);
  const T c3[3] = {T{}, all<T>(0.5), Scalar<T>(2 * kLn2 * kLn2) * m.pp};
  covariance_vjp(k[0] * p1 + k[1] * p2, p3, c3, more);
  for (int i = 0; i < 6; ++i) g[i] += more[i];
}

template <class T, class V>
GS_HD GaussianGradient<V> project_splat_vjp(const RayCamera<T>& cam, const Gaussian<V>& gaussian, bool antialiasing,
                                            bool perpendicular, V* g_covariance, const RayMoments<V>& m,
                                            V g_inverse_depth) {
  GaussianGradient<V> g;
  const Vec3<V> view = to_view(cam, gaussian.mean);
  const Perspective<V> p = perspective(cam, view);
  const Footprint<V> f = splat_footprint(cam, p, gaussian.axes);
  const Vec3<V> p3 = p.inverse_depth * cam.row_z;
  const Slopes<V> s = make_slopes(f, row_of(p3, gaussian.axes));
  g.log_opacity = m.on_image.q;
  mean_vjp(f, m.on_image, g.pixel_x, g.pixel_y);
  if (g_covariance) ray_covariance_vjp(f, m, s, antialiasing, p.p1, p.p2, p3, g_covariance);
  Vec3<V> m3;
  const ShapeGradient<V> shape = ray_vjp(f, m, s, antialiasing, m3);
  shape_vjp(cam, gaussian, view, p, shape, perpendicular, g_inverse_depth, g);
  if (!perpendicular) {
    const V row3[3] = {m3.x, m3.y, m3.z};
    for (int k = 0; k < 3; ++k) g.direction[k] = g.direction[k] + (gaussian.axes.scale[k] * row3[k]) * p3;
  }
  return g;
}

GS_ISA_END
