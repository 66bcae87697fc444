#pragma once
// The work of every backend on one Gaussian: from the Scene's rows to a Splat, and from moments to rows of gradients.
#include <cmath>

#include "../data.h"
#include "projection.h"

GS_ISA_BEGIN

template <class T>
GS_HD Camera<T> camera_of(const Scene<T>& s) {
  return make_camera(s.view, s.projection, s.center, s.tan_x, s.tan_y, s.image.width, s.image.height);
}

// A Gaussian, and what the derivatives of its activations need.
template <class T>
struct Loaded {
  Gaussian<T> gaussian;
  Quat<T> rotation;  // as used: normalised if raw
  T rotation_norm;
};

template <class T>
GS_HD Loaded<T> load(const Scene<T>& s, int64_t i) {
  Loaded<T> out{};
  Gaussian<T>& g = out.gaussian;
  g.mean = load3(s.means + 3 * i);
  g.log2_opacity = s.raw ? log2_sigmoid(s.opacities[i]) : std::log2(s.opacities[i]);
  if (s.cov3d) {
    g.axes = axes_of_covariance(s.cov3d + 6 * i);
    return out;
  }
  const T* q = s.rotations + 4 * i;
  out.rotation = {q[0], q[1], q[2], q[3]};
  if (s.raw) out.rotation = normalise(out.rotation, out.rotation_norm);
  rotation_columns(out.rotation, g.axes.direction);
  for (int k = 0; k < 3; ++k) {
    const T scale = s.scales[3 * i + k];
    g.axes.scale[k] = s.scale_modifier * (s.raw ? std::exp(scale) : scale);
  }
  return out;
}

// Checks values whose faults may not show in the mean or the footprint, which are checked later. Infinite logits are
// valid: programs that set the opacities 0 and 1 write them.
template <class T>
GS_HD bool finite_shape(const Scene<T>& s, int64_t i) {
  const T opacity = s.opacities[i];
  const bool good = s.raw ? !std::isnan(opacity) : std::isfinite(opacity);
  if (s.cov3d) return good & finite(load3(s.cov3d + 6 * i)) & finite(load3(s.cov3d + 6 * i + 3));
  return good & finite(load3(s.scales + 3 * i)) & finite(load3(s.rotations + 4 * i)) &
         std::isfinite(s.rotations[4 * i + 3]);
}

// Computes a splat except its colour. Returns false if it is culled; its depth is infinite then, so that it sorts last.
template <class T>
GS_HD bool project_shape(const Scene<T>& s, const Camera<T>& camera, int64_t i, Splat<T>& splat, T& depth,
                         int& radius) {
  radius = 0;
  depth = T(INFINITY);
  if (!finite_shape(s, i)) return false;
  T z;
  if (!project_splat(camera, load(s, i).gaussian, s.antialiasing, splat, z, radius)) return false;
  depth = z;
  return true;
}

// Computes the colour's basis at the direction from which Gaussian i is seen; returns its distance.
template <class T>
GS_HD T color_basis(const Scene<T>& s, const Camera<T>& camera, int64_t i, Vec3<T>& direction, T* basis) {
  const T norm = sh_direction(load3(s.means + 3 * i) - camera.center, direction);
  sh_basis(s.sh_degree, direction, basis);
  return norm;
}

// Computes a splat's colour; `rest` is its row of sh_rest, which may be a copy. Returns false if the colour is not
// finite or too large.
template <class T>
GS_HD bool project_color(const Scene<T>& s, const Camera<T>& camera, int64_t i, const T* rest, Splat<T>& splat) {
  Vec3<T> c;
  if (s.colors) {
    c = load3(s.colors + 3 * i);
  } else {
    T basis[sh_count(kMaxShDegree)];
    Vec3<T> direction;
    color_basis(s, camera, i, direction, basis);
    c = sh_color(s.sh_degree, basis, s.sh_dc + s.dc_stride * i, rest);
  }
  if (!finite(c) || !(larger(larger(std::abs(c.x), std::abs(c.y)), std::abs(c.z)) < T(kMaxColor))) return false;
  if (!s.colors)
    c = {larger(c.x, T(0)), larger(c.y, T(0)), larger(c.z, T(0))};  // after the test, because this hides -Inf
  splat.r = c.x, splat.g = c.y, splat.b = c.z;
  return true;
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
template <class T>
GS_HD Vec3<T> color_vjp(const Scene<T>& s, const Camera<T>& camera, int64_t i, Vec3<T> g, const T* rest, T* g_dc,
                        T* g_rest) {
  constexpr int kCount = sh_count(kMaxShDegree);
  T basis[kCount], weight[kCount];
  Vec3<T> direction;
  const T norm = color_basis(s, camera, i, direction, basis);
  const Vec3<T> c = sh_color(s.sh_degree, basis, s.sh_dc + s.dc_stride * i, rest);
  const T black = T(kBlack);
  g = {c.x >= black ? g.x : T(0), c.y >= black ? g.y : T(0), c.z >= black ? g.z : T(0)};
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
        store3(g_rest + 3 * (k - 1), Vec3<T>{0, 0, 0});
    }
  return sh_direction_vjp(direction, norm, sh_basis_vjp(s.sh_degree, direction, weight));
}

// Computes the gradients of Gaussian i from its moments m, and writes them to row `to` of `out`, except that of
// sh_rest. Those of tensors that the scene lacks are not written.
template <class T>
GS_HD void project_vjp_row(const Scene<T>& s, const Camera<T>& camera, int64_t i, const T* m, const T* rest, T* g_rest,
                           const SceneGradient<T>& out, int64_t to) {
  const Loaded<T> in = load(s, i);
  const GaussianGradient<T> g =
      project_splat_vjp(camera, in.gaussian, s.antialiasing, s.raw, out.cov3d ? out.cov3d + 6 * to : nullptr,
                        Moments<T>{m[0], m[1], m[2], m[3], m[4], m[5]}, m[9]);
  Vec3<T> g_mean = g.mean;
  const Vec3<T> g_color = {m[6], m[7], m[8]};
  if (s.colors) {
    if (out.colors) store3(out.colors + 3 * to, g_color);
  } else {
    g_mean = g_mean + color_vjp(s, camera, i, g_color, rest, out.sh_dc ? out.sh_dc + 3 * to : nullptr, g_rest);
  }
  if (out.means) store3(out.means + 3 * to, g_mean);
  if (out.means2d)
    store3(out.means2d + 3 * to,
           Vec3<T>{g.pixel_x * T(0.5) * T(s.image.width), g.pixel_y * T(0.5) * T(s.image.height), T(0)});
  if (out.opacities)
    out.opacities[to] = g.log_opacity * (s.raw ? log_sigmoid_slope(s.opacities[i]) : 1 / s.opacities[i]);
  if (out.scales && s.scales)
    for (int k = 0; k < 3; ++k) {
      const T scale = s.raw ? T(1) : s.scales[3 * i + k];
      out.scales[3 * to + k] = scale != 0 ? g.log_scale[k] / scale : T(0);  // the loss is even in the scale
    }
  if (out.rotations && s.rotations) {
    const Quat<T> q =
        s.raw ? normalise_vjp(in.rotation, in.rotation_norm, g.torque) : rotation_columns_vjp(in.rotation, g.direction);
    T* row = out.rotations + 4 * to;
    row[0] = q.w, row[1] = q.x, row[2] = q.y, row[3] = q.z;
  }
}

GS_ISA_END
