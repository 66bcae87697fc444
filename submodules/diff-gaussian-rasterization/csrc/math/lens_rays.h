#pragma once
// Gaussians on the rays of a lens's pixels (ray.h).
//
// Around a mean m of the view take the coordinates K r of a direction r: the rows of K are depth J, J the lens's
// Jacobian at m, and n, by which depth is measured: the axis of a perspective lens, else m's own direction. They are
// what (d, 1) is to a pinhole, K m = depth (0, 0, 1), but for the scale of r, which does not matter:
//   D^2 = q / (s^2 + e q),   (u, v) = L (K r)_xy,   q = u^2 + v^2,   s = n r + slope (u, v).
// So u, v and s are linear in r, and a splat is nine factors of r. The dilation is of 0.3 px^2 of the lens at the mean.
#include "lens_camera.h"
#include "ray.h"

GS_ISA_BEGIN

// A lens whose Gaussians are seen on rays.
template <class T>
struct LensRayCamera : LensCamera<T> {};
template <class T>
constexpr int kOnRays<LensRayCamera<T>> = kLensRays;

// J is not clamped. p3: the third row of K W over depth, as p1 and p2 are of J W.
template <class V>
struct LensRayView : LensView<V> {
  Vec3<V> n, p3;
  Vec3<V> toward;      // of the backward: the gradient of the mean, on the rows of J and n / depth
  AlongAxes<V> turns;  // of the backward: the gradient of J, but for what goes along with `toward`
  Vec3<V> deep;        // of the backward: the same of n / depth
};

// Where a chart has poles, a mean beside one counts as lying where its derivatives are taken.
template <class T, class V>
GS_HD Vec3<V> off_poles(const Lens<T>& lens, Vec3<V> p) {
  if (lens.chart != Chart::kEquirectangular) return p;
  if constexpr (kIsScalar<V>) {
    return off_pole(p);
  } else {
    for (int lane = 0; lane < int(sizeof(V) / sizeof(T)); ++lane) {
      const Vec3<T> one = off_pole(Vec3<T>{p.x[lane], p.y[lane], p.z[lane]});
      p.x[lane] = one.x, p.y[lane] = one.y, p.z[lane] = one.z;
    }
    return p;
  }
}

template <class T, class V>
GS_HD LensRayView<V> perspective(const LensRayCamera<T>& cam, Vec3<V> view) {
  LensRayView<V> p = {};
  p.clamped = off_poles(cam.lens, view);
  p.on = on_lens_of<1>(cam.lens, p.clamped);
  p.inverse_depth = 1 / depth_of(cam, view);
  p.n = Vec3<V>{V{}, V{}, all<V>(1)};
  if (cam.lens.chart != Chart::kPerspective) p.n = (1 / length(p.clamped)) * p.clamped;
  const auto row = [&](const V* by) { return by[0] * cam.row_x + by[1] * cam.row_y + by[2] * cam.row_z; };
  const V n[3] = {p.n.x, p.n.y, p.n.z};
  p.p1 = row(p.on.first[0]), p.p2 = row(p.on.first[1]), p.p3 = p.inverse_depth * row(n);
  return p;
}

// Where a perspective lens shows a mean beyond its field, for which no slope of pixels is known: the point of the field
// next to it.
template <class T, class V>
GS_HD void into_field(const Lens<T>& lens, const LensRayView<V>& p, Vec3<V> view, Splat<V>& splat) {
  const Truth<V> beyond = p.on.field > lens.field * lens.field;
  if (lens.chart != Chart::kPerspective || !any(beyond)) return;
  const V into = lens.field / root(p.on.field);
  const OnLens<V> there = on_lens_of<1>(lens, Vec3<V>{into * view.x, into * view.y, view.z});
  splat.x = beyond ? there.value[0] : splat.x, splat.y = beyond ? there.value[1] : splat.y;
}

// As for pinholes. Of the mean's pixel, tiles alone are made.
template <class T, class V>
GS_HD Truth<V> project_splat(const LensRayCamera<T>& cam, const Gaussian<V>& gaussian, bool antialiasing,
                             LensRaySplat<V>& splat, V& depth, Integer<V>& radius) {
  const LensCamera<T>& flat = cam;
  Splat<V>& on_image = splat;
  Truth<V> visible = project_splat(flat, gaussian, false, on_image, depth, radius);
  if (!any(visible)) return visible;
  const Vec3<V> view = to_view(cam, gaussian.mean);
  const LensRayView<V> p = perspective(cam, view);
  const Footprint<V> f = splat_footprint(flat, p, gaussian.axes);
  const Slopes<V> s = make_slopes(f, row_of(p.p3, gaussian.axes));
  splat.l11 = f.l11, splat.l12 = f.l12, splat.l22 = f.l22;
  splat.slope_u = s.slope_u, splat.slope_v = s.slope_v, splat.e = s.e;
  const Vec3<V> j1 = depth * load3(p.on.first[0]), j2 = depth * load3(p.on.first[1]);
  splat.to_u = f.l11 * j1 + f.l12 * j2, splat.to_v = f.l22 * j2, splat.n = p.n;
  into_field(cam.lens, p, view, on_image);
  if (antialiasing) splat.log2_opacity += binary_log(f.compensation);
  visible &= is_finite(f.l12) & (f.l11 > 0) & (f.l22 > 0) & (f.a + f.c < T(kMaxVariance));
  visible &= finite(splat.to_u) & finite(splat.to_v);
  return visible & is_finite(s.slope_u) & is_finite(s.slope_v) & is_finite(s.e) &
         (splat.log2_opacity >= T(kLog2MinAlpha) - T(1e-3));
}

// The gradients of J and of the mean. With nu = Cov^-1 ((0, 0, 1) - t K r), t K r the ray's point next to the mean, the
// gradient of the covariance is S = sum q nu nu^T / 2, and of M = (J; n / depth) W R S it is 2 S M. D^2 is the same in
// any coordinates. So a change of K moves it by the mean alone, K m = depth (0, 0, 1), and by the dilation, which is of
// these coordinates: -(J; n / depth) gets F m^T + 2 h S (b1, b2, 0)^T, F = -sum q nu, and b1 and b2 the moves of the
// mean at its depth by a pixel. Antialiasing is of M alone.
template <class T, class V>
GS_HD void take_toward(const LensRayCamera<T>& cam, const Gaussian<V>& gaussian, const Footprint<V>& f,
                       const RayMoments<V>& m, const Slopes<V>& s, Vec3<V> m3, bool antialiasing,
                       const GaussianGradient<V>& g, LensRayView<V>& p) {
  using Number = Scalar<V>;
  Vec3<V> unused;
  const ShapeGradient<V> bare = ray_vjp(f, m, s, false, unused);
  const V deep = m.on_image.quu + m.on_image.qvv + s.e * m.pp;
  p.toward = {g.pixel_x - dot(bare.m1, m3), g.pixel_y - dot(bare.m2, m3), Number(-2 * kLn2) * deep};
  V c2[3], third[2];
  covariance2d_vjp(f, pulling_moments(f, m, s, third), false, c2);
  const Vec3<V> j1 = load3(p.on.first[0]), j2 = load3(p.on.first[1]), normal = cross(j1, j2);
  const V per_volume = -2 * f.dilation.area / dot(p.n, normal);
  const Vec3<V> b1 = per_volume * cross(j2, p.n), b2 = per_volume * cross(p.n, j1);
  const Vec3<V> h1 = c2[0] * b1 + c2[1] * b2, h2 = c2[1] * b1 + c2[2] * b2;
  p.deep = Number(0.5) * (third[0] * b1 + third[1] * b2);
  if (antialiasing) {
    const ShapeGradient<V> dimmed = footprint_vjp(f, Moments<V>{m.on_image.q, {}, {}, {}, {}, {}}, true);
    const Vec3<V>&d1 = dimmed.m1, &d2 = dimmed.m2;
    p.turns = along_view(cam, gaussian.axes, {d1.x, d1.y, d1.z}, {d2.x, d2.y, d2.z});
  }
  const Vec3<V> h[2] = {h1, h2};
  for (int i = 0; i < 2; ++i) p.turns.of[i][0] += h[i].x, p.turns.of[i][1] += h[i].y, p.turns.of[i][2] += h[i].z;
}

// For shape_vjp.
template <class T, class V>
GS_HD Vec3<V> position_vjp(const LensRayCamera<T>& cam, Vec3<V> view, const LensRayView<V>& p, const AlongAxes<V>&,
                           Vec3<V>, V, V, V g_inverse_depth) {
  V bent[3] = {};
  Vec3<V> g = view_vjp(cam, p.clamped, p, p.turns, p.toward.x, p.toward.y, V{}, bent);
  g = g + (p.inverse_depth * p.toward.z) * p.n;
  const V square = p.inverse_depth * p.inverse_depth;
  if (cam.lens.chart == Chart::kPerspective)
    g.z -= square * g_inverse_depth;
  else
    g = g + square * p.deep - (square * p.inverse_depth * g_inverse_depth) * view;
  return g.x * cam.row_x + g.y * cam.row_y + g.z * cam.row_z;
}

template <class T, class V>
GS_HD GaussianGradient<V> project_splat_vjp(const LensRayCamera<T>& cam, const Gaussian<V>& gaussian, bool antialiasing,
                                            bool perpendicular, V* g_covariance, const RayMoments<V>& m,
                                            V g_inverse_depth) {
  const LensCamera<T>& flat = cam;
  GaussianGradient<V> g;
  const Vec3<V> view = to_view(cam, gaussian.mean);
  LensRayView<V> p = perspective(cam, view);
  const Footprint<V> f = splat_footprint(flat, p, gaussian.axes);
  const Vec3<V> m3 = row_of(p.p3, gaussian.axes);
  const Slopes<V> s = make_slopes(f, m3);
  g.log_opacity = m.on_image.q;
  mean_vjp(f, m.on_image, g.pixel_x, g.pixel_y);
  if (g_covariance) ray_covariance_vjp(f, m, s, antialiasing, p.p1, p.p2, p.p3, g_covariance);
  take_toward(cam, gaussian, f, m, s, m3, antialiasing, g, p);
  Vec3<V> row3;
  const ShapeGradient<V> shape = ray_vjp(f, m, s, antialiasing, row3);
  shape_vjp(cam, gaussian, view, p, shape, perpendicular, g_inverse_depth, g);
  if (!perpendicular) {
    const V third[3] = {row3.x, row3.y, row3.z};
    for (int k = 0; k < 3; ++k) g.direction[k] = g.direction[k] + (gaussian.axes.scale[k] * third[k]) * p.p3;
  }
  return g;
}

// The tiles of a box around all directions that the splat reaches. They turn from the mean's by at most `turn`, of a
// perspective lens the chart's numbers do: q <= reach s^2, and |(u, v)| is at least its least factor times that.
template <class T, class V>
GS_HD Rect<Integer<V>> rect_of(const LensRayCamera<T>& cam, LensRaySplat<V>& s, Image image) {
  const Lens<T>& lens = cam.lens;
  const V far = all<V>(1e9), level = s.log2_opacity - T(kLog2MinAlpha);
  const V deviations = root(larger(level, V{})) * T(1.0001) + T(0.01), square = deviations * deviations;
  const V outside = 1 - s.e * square, reach = root(larger(square / outside, V{}));
  const V rest = 1 - reach * length(s.slope_u, s.slope_v);
  Vec3<V> u = s.to_u, v = s.to_v;
  if (lens.chart == Chart::kPerspective) u.z = v.z = V{};
  const Vec3<V> area = cross(u, v);
  const V sum = dot(u, u) + dot(v, v), det = 4 * dot(area, area);
  const V least = det / (2 * (sum + root(larger(sum * sum - det, V{}))));
  const Truth<V> bounded = (outside > T(1e-3)) & (rest > T(1e-3)) & (least > 0);
  const V turn = bounded ? reach / rest / root(least) * T(1.001) : far;
  // A fisheye stretches what is beside its axis by theta / sin(theta), at most pi r^2 / (1 + 2 r) with r the inverse of
  // cos(theta / 2) (Shafer 1966): theta is the mean's angle from the axis and the turn.
  const V inverse = 1 / root(1 + turn * turn), across_axis = length(s.n.x, s.n.y);
  const V cosine = (s.n.z - across_axis * turn) * inverse, sine_more = (across_axis + s.n.z * turn) * inverse;
  const V half = root(2 / larger(1 + cosine, all<V>(1e-6)));
  const V stretch = sine_more > 0 ? T(kPi) * half * half / (1 + 2 * half) : far;
  V across = lens.slope * turn * (lens.chart == Chart::kEquidistant ? stretch : all<V>(1)) + 1, down = across;
  if (lens.chart == Chart::kEquirectangular) {
    const V sine = turn * inverse, left = s.n.x * s.n.x + s.n.z * s.n.z - sine * sine;
    across = left > T(1e-5) ? lens.focal_x * sine / root(left) * T(1.001) + 1 : far, down = lens.focal_y * turn + 1;
    const T turn_around = T(kPi) * lens.focal_x;
    const Truth<V> crosses =
        (s.x - across < lens.center_x - turn_around) | (s.x + across > lens.center_x + turn_around);
    across = crosses ? far : across;
  }
  return tiles_between<V>(level > T(-1e-3), s.x - across, s.x + across, s.y - down, s.y + down, image.width,
                          image.height);
}

template <class AnyCamera, class AnySplat>
GS_HD auto rect_of(const AnyCamera& cam, AnySplat& s, Image image) {
  return tile_rect(s, image.width, image.height, goes_around(cam));
}

GS_ISA_END
