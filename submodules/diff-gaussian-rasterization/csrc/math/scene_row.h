#pragma once
// The work of every backend on one Gaussian: from the Scene's rows to a Splat, and from moments to rows of gradients.
#include <cmath>

#include "../data.h"
#include "lens_rays.h"

GS_ISA_BEGIN

template <class T>
GS_HD Camera<T> camera_of(const Scene<T>& s) {
  return make_camera(s.view, s.projection, s.center, s.tan_x, s.tan_y, s.image.width, s.image.height, s.near);
}

template <class T>
GS_HD void set_camera(const Scene<T>& s, Camera<T>& camera) {
  camera = camera_of(s);
}
template <class T>
GS_HD void set_camera(const Scene<T>& s, LensCamera<T>& camera) {
  static_cast<Camera<T>&>(camera) = camera_of(s);
  const Lens<T>& lens = camera.lens = s.lens;
  const double width = s.image.width, height = s.image.height, reach = lens.reach;
  clamp_rays((2 * lens.center_x + 1) / width - 1, (2 * lens.center_y + 1) / height - 1,
             reach * width / (2 * lens.focal_x), reach * height / (2 * lens.focal_y), camera);
  const double half = kPi * lens.focal_x, least = 1e-2;  // px; floats of a wide image round
  camera.around = lens.chart == Chart::kEquirectangular && std::abs(lens.center_x + 0.5 - half) < least &&
                  std::abs(lens.center_x + 0.5 + half - width) < least;
}

// Calls run(camera) with a Camera, or a LensCamera where the scene has a lens.
template <class T, class Run>
void with_camera(const Scene<T>& s, const Run& run) {
  if (s.lens.chart == Chart::kPinhole) return run(camera_of(s));
  LensCamera<T> camera;
  set_camera(s, camera);
  run(camera);
}

// The same, or with a camera of rays.
template <class T, class Run>
void with_any_camera(const Scene<T>& s, const Run& run) {
  if (s.rays() == kPinholeRays) return run(RayCamera<T>{camera_of(s)});
  if (s.rays() == kNoRays) return with_camera(s, run);
  LensRayCamera<T> camera;
  set_camera(s, camera);
  run(camera);
}

// A Gaussian's parameters as they are stored. They are read where they are used: a GPU would keep them in registers
// until then. Of the shape, the scene has the scales and the rotation, or the covariance.
template <class T>
struct SceneRow {
  using Number = T;
  const Scene<T>& s;
  int64_t i;

  GS_HD Vec3<T> mean() const { return load3(s.means + 3 * i); }
  GS_HD T opacity() const { return s.opacities[i]; }
  GS_HD T scale(int k) const { return s.scales[3 * i + k]; }
  GS_HD Quat<T> rotation() const {
    const T* q = s.rotations + 4 * i;
    return {q[0], q[1], q[2], q[3]};
  }
  GS_HD const T* cov3d() const { return s.cov3d + 6 * i; }
  // Its colour, or the first coefficients of it.
  GS_HD Vec3<T> base() const { return load3(s.colors ? s.colors + 3 * i : s.sh_dc + s.dc_stride * i); }
};

// A Gaussian, and what the derivatives of its activations need.
template <class V>
struct Loaded {
  Gaussian<V> gaussian;
  Quat<V> rotation;  // as used
  V rotation_norm;
};

// Row: SceneRow, or what holds the values of several (cpu/scene_lanes.h).
template <class T, class Row, class V = typename Row::Number>
GS_HD Loaded<V> load(const Scene<T>& s, const Row& row) {
  Loaded<V> out{};
  Gaussian<V>& g = out.gaussian;
  g.mean = row.mean();
  g.log2_opacity = s.raw ? log2_sigmoid(row.opacity()) : binary_log(row.opacity());
  if (s.cov3d) {
    g.axes = axes_of_covariance(row.cov3d());
    g.axes.dilation = s.dilation;
    return out;
  }
  out.rotation = row.rotation();
  if (s.any_rotation) out.rotation = normalise(out.rotation, out.rotation_norm);
  rotation_columns(out.rotation, g.axes.direction);
  g.axes.dilation = s.dilation;
  for (int k = 0; k < 3; ++k) {
    const V scale = row.scale(k);
    g.axes.scale[k] = s.scale_modifier * (s.raw ? exponential(scale) : scale);
  }
  return out;
}

// Checks values whose faults may not show in the mean or the footprint, which are checked later. Infinite logits are
// valid: programs that set the opacities 0 and 1 write them.
template <class T, class Row, class V = typename Row::Number>
GS_HD Truth<V> finite_shape(const Scene<T>& s, const Row& row) {
  const V opacity = row.opacity();
  const Truth<V> good = s.raw ? opacity == opacity : is_finite(opacity);
  if (s.cov3d) return good & finite(load3(row.cov3d())) & finite(load3(row.cov3d() + 3));
  const Quat<V> q = row.rotation();
  return good & finite(Vec3<V>{row.scale(0), row.scale(1), row.scale(2)}) & finite(Vec3<V>{q.w, q.x, q.y}) &
         is_finite(q.z);
}

// Computes a splat except its colour, and its depth. Returns false if it is culled.
template <class T, class AnyCamera, class Row, class AnySplat, class V = typename Row::Number>
GS_HD Truth<V> project_shape(const Scene<T>& s, const AnyCamera& camera, const Row& row, AnySplat& splat, V& depth,
                             Integer<V>& radius) {
  const Truth<V> good = finite_shape(s, row);
  radius = Integer<V>{};
  if (!any(good)) return good;
  Integer<V> wide;
  const Truth<V> visible = project_splat(camera, load(s, row).gaussian, s.antialiasing, splat, depth, wide);
  radius = good ? wide : radius;
  return good & visible;
}

// Computes the colour's basis at the direction from which a mean is seen; returns its distance.
template <class T, class V>
GS_HD V color_basis(const Scene<T>& s, const Camera<T>& camera, Vec3<V> mean, Vec3<V>& direction, V* basis) {
  const V norm = sh_direction(mean - camera.center, direction);
  sh_basis(s.sh_degree, direction, basis);
  return norm;
}

// Computes a splat's colour; `rest` is its row of sh_rest, which may be a copy. Returns false if the colour is not
// finite or too large.
template <class T, class Row, class V = typename Row::Number>
GS_HD Truth<V> project_color(const Scene<T>& s, const Camera<T>& camera, const Row& row, const V* rest,
                             Splat<V>& splat) {
  Vec3<V> c;
  if (s.colors) {
    c = row.base();
  } else {
    V basis[sh_count(kMaxShDegree)] = {};
    Vec3<V> direction;
    color_basis(s, camera, row.mean(), direction, basis);
    c = sh_color(s.sh_degree, basis, row.base(), rest);
  }
  const Truth<V> good = finite(c) & (larger(larger(magnitude(c.x), magnitude(c.y)), magnitude(c.z)) < T(kMaxColor));
  if (!s.colors) c = {larger(c.x, V{}), larger(c.y, V{}), larger(c.z, V{})};  // after the test, because this hides -Inf
  splat.r = c.x, splat.g = c.y, splat.b = c.z;
  return good;
}

template <class T>
GS_HD void zero_row(T* rows, int64_t i, int row) {
  if (rows)
    for (int k = 0; k < row; ++k) rows[row * i + k] = 0;
}

// Zeroes all gradients of a Gaussian that was not seen, except that of sh_rest.
template <class T>
GS_HD void zero_gradient(int64_t i, const SceneGradient<T>& out) {
  zero_row(out.means, i, 3), zero_row(out.means2d, i, 3), zero_row(out.opacities, i, 1);
  zero_row(out.scales, i, 3), zero_row(out.rotations, i, 4), zero_row(out.cov3d, i, 6);
  zero_row(out.colors, i, 3), zero_row(out.sh_dc, i, 3);
}

// Computes the coefficients' gradients, and returns the mean's through the viewing direction. `rest` is the row of
// sh_rest, g_dc and g_rest are those of the gradients (or null). `rest` and g_rest may be the same memory.
template <class T, class Row, class V = typename Row::Number>
GS_HD Vec3<V> color_vjp(const Scene<T>& s, const Camera<T>& camera, const Row& row, Vec3<V> g, const V* rest, V* g_dc,
                        V* g_rest) {
  constexpr int kCount = sh_count(kMaxShDegree);
  V basis[kCount] = {}, weight[kCount] = {};
  Vec3<V> direction;
  const V norm = color_basis(s, camera, row.mean(), direction, basis), zero = {};
  const Vec3<V> c = sh_color(s.sh_degree, basis, row.base(), rest);
  const T black = T(kBlack);
  g = {c.x >= black ? g.x : zero, c.y >= black ? g.y : zero, c.z >= black ? g.z : zero};
  if (g_dc) store3(g_dc, basis[0] * g);
  const int active = sh_count(s.sh_degree);
  // Loops of constant length let a GPU keep the arrays in registers. All of a row is read before it may be written.
  for (int k = 1; k < kCount; ++k)
    if (k < active) weight[k] = dot(load3(rest + 3 * (k - 1)), g);
  if (g_rest)
    for (int k = 1; k < kCount; ++k) {
      if (k < active)
        store3(g_rest + 3 * (k - 1), basis[k] * g);
      else if (k <= s.rest_bands)
        store3(g_rest + 3 * (k - 1), Vec3<V>{zero, zero, zero});
    }
  return sh_direction_vjp(direction, norm, sh_basis_vjp(s.sh_degree, direction, weight));
}

template <class V>
GS_HD Moments<V> moments_of(const V* m) {
  return {m[0], m[1], m[2], m[3], m[4], m[5]};
}

// Computes a Gaussian's gradients from its moments m, and writes them to row `to` of `out`, except that of sh_rest.
// Those of tensors that the scene lacks are not written.
template <class T, class AnyCamera, class Row, class V = typename Row::Number>
GS_HD void project_vjp_row(const Scene<T>& s, const AnyCamera& camera, const Row& row, const V* m, const V* rest,
                           V* g_rest, const SceneGradient<V>& out, int64_t to) {
  const Loaded<V> in = load(s, row);
  V* g_covariance = out.cov3d ? out.cov3d + 6 * to : nullptr;
  const auto shape_gradient = [&](const auto& moments) {
    return project_splat_vjp(camera, in.gaussian, s.antialiasing, s.any_rotation, g_covariance, moments, m[9]);
  };
  GaussianGradient<V> g;
  if constexpr (kOnRays<AnyCamera> != kNoRays)
    g = shape_gradient(RayMoments<V>{moments_of(m), m[10], m[11], m[12]});
  else
    g = shape_gradient(moments_of(m));
  Vec3<V> g_mean = g.mean;
  const Vec3<V> g_color = {m[6], m[7], m[8]};
  if (s.colors) {
    if (out.colors) store3(out.colors + 3 * to, g_color);
  } else {
    V* g_dc = out.sh_dc ? out.sh_dc + 3 * to : nullptr;
    g_mean = g_mean + color_vjp(s, camera, row, g_color, rest, g_dc, g_rest);
  }
  if (out.means) store3(out.means + 3 * to, g_mean);
  if (out.means2d)
    store3(out.means2d + 3 * to,
           Vec3<V>{g.pixel_x * T(0.5) * T(s.image.width), g.pixel_y * T(0.5) * T(s.image.height), V{}});
  if (out.opacities) out.opacities[to] = g.log_opacity * (s.raw ? log_sigmoid_slope(row.opacity()) : 1 / row.opacity());
  if (out.scales && s.scales)
    for (int k = 0; k < 3; ++k) {
      const V scale = s.raw ? all<V>(1) : row.scale(k);
      out.scales[3 * to + k] = scale != 0 ? g.log_scale[k] / scale : V{};  // the loss is even in the scale
    }
  if (out.rotations && s.rotations) {
    const Quat<V> q = s.any_rotation ? normalise_vjp(in.rotation, in.rotation_norm, g.torque)
                                     : rotation_columns_vjp(in.rotation, g.direction);
    V* to_row = out.rotations + 4 * to;
    to_row[0] = q.w, to_row[1] = q.x, to_row[2] = q.y, to_row[3] = q.z;
  }
}

GS_ISA_END
