#pragma once
// Projection of one Gaussian by one camera, and its derivative.
#include "camera.h"
#include "covariance.h"
#include "footprint.h"
#include "sh.h"
#include "splat.h"
#include "tiles.h"

GS_ISA_BEGIN

// A Gaussian with activated parameters.
template <class T>
struct Gaussian {
  Vec3<T> mean;
  Axes<T> axes;
  T log2_opacity;
};

// Perspective at a view-space point: the ray (x/z, y/z) and the rows p1, p2 of J W. J is the Jacobian of Zwicker et al.
// 2001, eq. 29, at the ray clamped to 1.3 half images.
template <class T>
struct Perspective {
  T inverse_depth;  // 1/z
  T ray_x, ray_y, clamped_x, clamped_y;
  Vec3<T> p1, p2;
};

template <class T, class V>
GS_HD Truth<V> shown(const Camera<T>& cam, Vec3<V> view) {
  return in_front(cam, view.z);
}
template <class T, class V>
GS_HD V depth_of(const Camera<T>&, Vec3<V> view) {
  return view.z;
}

template <class T, class V>
GS_HD Perspective<V> perspective(const Camera<T>& cam, Vec3<V> view) {
  Perspective<V> p;
  p.inverse_depth = 1 / view.z;
  p.ray_x = view.x * p.inverse_depth, p.ray_y = view.y * p.inverse_depth;
  p.clamped_x = clamp(p.ray_x, all<V>(cam.ray_min_x), all<V>(cam.ray_max_x));
  p.clamped_y = clamp(p.ray_y, all<V>(cam.ray_min_y), all<V>(cam.ray_max_y));
  p.p1 = (cam.focal_x * p.inverse_depth) * (cam.row_x - p.clamped_x * cam.row_z);
  p.p2 = (cam.focal_y * p.inverse_depth) * (cam.row_y - p.clamped_y * cam.row_z);
  return p;
}

// Where the image shows the mean; returns whether it does.
template <class T, class V>
GS_HD Truth<V> image_point(const Camera<T>& cam, const Perspective<V>& p, V& x, V& y) {
  x = cam.mean_focal_x * p.ray_x + cam.axis_x, y = cam.mean_focal_y * p.ray_y + cam.axis_y;
  return is_finite(x) & is_finite(y);
}

// A row of M from that of J W.
template <class V>
GS_HD Vec3<V> row_of(Vec3<V> p, const Axes<V>& axes) {
  const auto& d = axes.direction;
  const auto& s = axes.scale;
  return {s[0] * dot(p, d[0]), s[1] * dot(p, d[1]), s[2] * dot(p, d[2])};
}

// M = J W R S and its minors. p1 x p2 = fx fy / z^2 (clamped ray, 1) with the dual rows of W, which for a rotation is
// W^T (clamped ray, 1). The minor of columns i, j is its dot product with axis_i x axis_j: no difference of large
// products, however thin the splat.
template <class T, class V>
GS_HD Footprint<V> splat_footprint(const Camera<T>& cam, const Perspective<V>& p, const Axes<V>& axes) {
  const auto& d = axes.direction;
  const auto& s = axes.scale;
  const Vec3<V> ray = cam.dual_z + p.clamped_x * cam.dual_x + p.clamped_y * cam.dual_y;
  const V fx = cam.focal_x * p.inverse_depth, fy = cam.focal_y * p.inverse_depth;
  const Vec3<V> minors = {(fx * s[1]) * (fy * s[2]) * dot(ray, cross(d[1], d[2])),
                          (fx * s[2]) * (fy * s[0]) * dot(ray, cross(d[2], d[0])),
                          (fx * s[0]) * (fy * s[1]) * dot(ray, cross(d[0], d[1]))};
  return make_footprint(row_of(p.p1, axes), row_of(p.p2, axes), minors, axes.dilation);
}

// Computes a splat except its colour. Opacity, scales and rotation must be finite. Returns false if it is culled:
// behind the camera, not finite or too large on the image, or too faint to be seen anywhere.
template <class AnyCamera, class V>
GS_HD Truth<V> project_splat(const AnyCamera& cam, const Gaussian<V>& gaussian, bool antialiasing, Splat<V>& splat,
                             V& depth, Integer<V>& radius) {
  using T = Scalar<V>;
  radius = Integer<V>{};
  const Vec3<V> view = to_view(cam, gaussian.mean);
  Truth<V> visible = shown(cam, view) & finite(view);
  if (!any(visible)) return visible;
  const auto p = perspective(cam, view);
  const Footprint<V> f = splat_footprint(cam, p, gaussian.axes);
  visible &= image_point(cam, p, splat.x, splat.y);
  splat.l11 = f.l11, splat.l12 = f.l12, splat.l22 = f.l22;
  splat.inverse_depth = p.inverse_depth;
  depth = depth_of(cam, view);
  visible &= is_finite(f.l12) & (f.l11 > 0) & (f.l22 > 0) & (f.a + f.c < T(kMaxVariance));
  if (!any(visible)) return visible;
  const Integer<V> wide = footprint_radius(f);
  radius = (visible & radius_on_image(splat.x, splat.y, wide, cam.width, cam.height)) ? wide : radius;
  const V log2_opacity = gaussian.log2_opacity + (antialiasing ? binary_log(f.compensation) : V{});
  // An opacity below 0 has no logarithm: its NaN stays, and is not visible.
  splat.log2_opacity = log2_opacity > T(kMaxLog2Opacity) ? all<V>(kMaxLog2Opacity) : log2_opacity;
  return visible & (splat.log2_opacity >= T(kLog2MinAlpha) - T(1e-3));  // the margin of tile_rect
}

// How far outside of the image's tiles a point lies, px.
template <class T, class V>
GS_HD V outside(const Camera<T>& cam, V x, V y) {
  return larger<V>(larger<V>(-x, x - T(cam.width + kTile)), larger<V>(-y, y - T(cam.height + kTile)));
}

// Whether a splat certainly has no tile and no radius, for a Gaussian with perpendicular axes and an opacity of at most
// 1. largest_scale() is asked for its largest scale only if its mean is off the image: its covariance on the image has
// at most the trace of a ball's of that scale. 3.34 standard deviations reach alpha 1/255, and `radii` count 3. The
// rest is for rounding.
template <class T, class V, class Scale>
GS_HD Truth<V> surely_outside(const Camera<T>& cam, Vec3<V> mean, const Scale& largest_scale) {
  const Vec3<V> view = to_view(cam, mean);
  const Truth<V> front = in_front(cam, view.z);
  const Perspective<V> p = perspective(cam, view);
  const V x = cam.mean_focal_x * p.ray_x + cam.axis_x, y = cam.mean_focal_y * p.ray_y + cam.axis_y;
  const V deviations = (outside<T, V>(cam, x, y) - 3) / T(3.5);
  const Truth<V> off = front & (deviations > 1);
  if (!any(off)) return !front;
  const V scale = largest_scale();
  const Truth<V> out = scale * scale * (dot(p.p1, p.p1) + dot(p.p2, p.p2)) + 1 < deviations * deviations;
  return (!front) | (off & out);
}

// The gradients of project_splat's inputs; the opacity's is d/d ln(opacity).
template <class T>
struct GaussianGradient {
  Vec3<T> mean;
  Vec3<T> torque;        // of turns about the axes, if they are known to be perpendicular
  Vec3<T> direction[3];  // of the axes, if they may not be perpendicular
  T log_scale[3];
  T log_opacity;
  T pixel_x, pixel_y;
};

// The torque about an axis, from the entry of M^T dM between the other two, whose scales are a and b: off (a/b - b/a),
// exactly 0 where they are equal. `off` has both scales as factors, so it can be divided by the smaller one.
template <class T>
GS_HD T torque(T off, T a, T b) {
  const T low = a < b ? a : b, high = larger(a, b);
  return low > 0 ? off / low * (a + b) * ((a - b) / high) : T{};
}

// What the gradient of J needs of dP's rows: their parts along the optical axis.
template <class T>
struct Along {
  T one, two;
};

// row1, row2: dM's rows, in the Gaussian's own frame.
template <class T, class V>
GS_HD Along<V> along_view(const Camera<T>& cam, const Axes<V>& axes, const V (&row1)[3], const V (&row2)[3]) {
  Along<V> along = {};
  for (int k = 0; k < 3; ++k) {
    const V depth = axes.scale[k] * dot(cam.row_z, axes.direction[k]);
    along.one += row1[k] * depth, along.two += row2[k] * depth;
  }
  return along;
}

// The gradient of the point of the view, times its depth, through its place on the image and through J. diagonal: of
// ShapeGradient. A clamped ray is constant: its coordinate gets no gradient through J, and z only through the factor
// 1/z.
template <class T, class V>
GS_HD Vec3<V> view_vjp(const Camera<T>& cam, const Perspective<V>& p, const Along<V>& along, Vec3<V> diagonal,
                       V pixel_x, V pixel_y, V g_inverse_depth) {
  V g_ray_x = cam.mean_focal_x * pixel_x, g_ray_y = cam.mean_focal_y * pixel_y;
  g_ray_x = p.clamped_x == p.ray_x ? g_ray_x - cam.focal_x * p.inverse_depth * along.one : g_ray_x;
  g_ray_y = p.clamped_y == p.ray_y ? g_ray_y - cam.focal_y * p.inverse_depth * along.two : g_ray_y;
  const V g_z = -(diagonal.x + diagonal.y + diagonal.z + p.ray_x * g_ray_x + p.ray_y * g_ray_y +
                  p.inverse_depth * g_inverse_depth);
  return {g_ray_x, g_ray_y, g_z};
}

template <class T, class V>
GS_HD Vec3<V> position_vjp(const Camera<T>& cam, Vec3<V>, const Perspective<V>& p, const Along<V>& along,
                           Vec3<V> diagonal, V pixel_x, V pixel_y, V g_inverse_depth) {
  const Vec3<V> g = view_vjp(cam, p, along, diagonal, pixel_x, pixel_y, g_inverse_depth);
  return p.inverse_depth * (g.x * cam.row_x + g.y * cam.row_y + g.z * cam.row_z);
}

// Fills the gradients that come from a footprint's, and the mean's. perpendicular: whether the axes are. p:
// Perspective, or LensView.
template <class V, class AnyCamera, class View>
GS_HD void shape_vjp(const AnyCamera& cam, const Gaussian<V>& gaussian, Vec3<V> view, const View& p,
                     const ShapeGradient<V>& shape, bool perpendicular, V g_inverse_depth, GaussianGradient<V>& g) {
  const auto& c = gaussian.axes.scale;
  const V row1[3] = {shape.m1.x, shape.m1.y, shape.m1.z}, row2[3] = {shape.m2.x, shape.m2.y, shape.m2.z};
  const auto along = along_view(cam, gaussian.axes, row1, row2);
  g.log_scale[0] = shape.diagonal.x, g.log_scale[1] = shape.diagonal.y, g.log_scale[2] = shape.diagonal.z;
  if (perpendicular)
    g.torque = {torque(shape.off.x, c[1], c[2]), torque(shape.off.y, c[2], c[0]), torque(shape.off.z, c[0], c[1])};
  else
    for (int k = 0; k < 3; ++k) g.direction[k] = c[k] * (row1[k] * p.p1 + row2[k] * p.p2);
  g.mean = position_vjp(cam, view, p, along, shape.diagonal, g.pixel_x, g.pixel_y, g_inverse_depth);
}

// d cov3d = P^T G P, of the gradient c2 of the covariance on the image; off-diagonal entries stand for two.
template <class V>
GS_HD void covariance_vjp(Vec3<V> p1, Vec3<V> p2, const V (&c2)[3], V* g) {
  const Vec3<V> a = c2[0] * p1 + c2[1] * p2, b = c2[1] * p1 + c2[2] * p2;
  g[0] = p1.x * a.x + p2.x * b.x;
  g[1] = p1.x * a.y + p2.x * b.y + p1.y * a.x + p2.y * b.x;
  g[2] = p1.x * a.z + p2.x * b.z + p1.z * a.x + p2.z * b.x;
  g[3] = p1.y * a.y + p2.y * b.y;
  g[4] = p1.y * a.z + p2.y * b.z + p1.z * a.y + p2.z * b.y;
  g[5] = p1.z * a.z + p2.z * b.z;
}

// perpendicular: whether the axes are. g_covariance (6, or null): the gradient of the covariance that gave the axes.
template <class V, class AnyCamera>
GS_HD GaussianGradient<V> project_splat_vjp(const AnyCamera& cam, const Gaussian<V>& gaussian, bool antialiasing,
                                            bool perpendicular, V* g_covariance, const Moments<V>& s,
                                            V g_inverse_depth) {
  GaussianGradient<V> g;
  const Vec3<V> view = to_view(cam, gaussian.mean);
  const auto p = perspective(cam, view);
  const Footprint<V> f = splat_footprint(cam, p, gaussian.axes);
  g.log_opacity = s.q;
  mean_vjp(f, s, g.pixel_x, g.pixel_y);

  if (g_covariance) {
    V c2[3];
    covariance2d_vjp(f, s, antialiasing, c2);
    covariance_vjp(p.p1, p.p2, c2, g_covariance);
  }
  shape_vjp(cam, gaussian, view, p, footprint_vjp(f, s, antialiasing), perpendicular, g_inverse_depth, g);
  return g;
}

GS_ISA_END
