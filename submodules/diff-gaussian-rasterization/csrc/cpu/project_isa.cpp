#include <cstring>

#include "../launch.h"
#include "../math/projection.h"
#include "list_tiles.h"

GS_ISA_BEGIN

namespace {

constexpr int64_t kGrain = 512;

template <class T>
Camera<T> camera_of(const Scene<T>& s) {
  return make_camera(s.view, s.projection, s.center, s.tan_x, s.tan_y, s.image.width, s.image.height);
}

// A Gaussian and what its activations' derivatives need.
template <class T>
struct Loaded {
  Gaussian<T> gaussian;
  Quat<T> rotation;  // as used: normalised if raw
  T rotation_norm;
};

template <class T>
Loaded<T> load(const Scene<T>& s, int64_t i) {
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

// Of what does not show in the mean or the colour, which are checked once computed.
template <class T>
bool finite_shape(const Scene<T>& s, int64_t i) {
  if (!std::isfinite(s.opacities[i])) return false;
  if (s.cov3d) return finite(load3(s.cov3d + 6 * i)) && finite(load3(s.cov3d + 6 * i + 3));
  return finite(load3(s.scales + 3 * i)) && finite(load3(s.rotations + 4 * i)) && std::isfinite(s.rotations[4 * i + 3]);
}

template <class T>
Vec3<T> unclamped_color(const Scene<T>& s, int64_t i, const T* basis) {
  return sh_color(s.sh_degree, basis, s.sh_dc + s.dc_stride * i, s.sh_rest + s.rest_stride * i);
}

template <class T>
bool usable_color(Vec3<T> c) {
  return larger(larger(std::abs(c.x), std::abs(c.y)), std::abs(c.z)) < T(kMaxColor) && finite(c);
}

template <class T>
void project_one(const Scene<T>& s, const Camera<T>& camera, int64_t i, const Projected<T>& out) {
  out.tile_counts[i] = 0;
  out.radii[i] = 0;
  Splat<T> splat;
  int radius;
  if (!finite_shape(s, i)) return;
  const Gaussian<T> gaussian = load(s, i).gaussian;
  const bool visible = project_splat(camera, gaussian, s.antialiasing, splat, out.depths[i], radius);
  out.radii[i] = radius;
  if (!visible) return;
  const TileRect rect = tile_rect(splat, s.image.width, s.image.height);
  const int32_t count = list_tiles(splat, rect, s.image, nullptr);
  if (!count) return;
  Vec3<T> color;
  if (s.colors) {
    color = load3(s.colors + 3 * i);
    if (!usable_color(color)) return;
  } else {
    T basis[sh_count(kMaxShDegree)];
    Vec3<T> direction;
    sh_direction(gaussian.mean - camera.center, direction);
    sh_basis(s.sh_degree, direction, basis);
    color = unclamped_color(s, i, basis);
    if (!usable_color(color)) return;  // before the clamp, which would turn -Inf into 0
    color = {larger(color.x, T(0)), larger(color.y, T(0)), larger(color.z, T(0))};
  }
  splat.r = color.x, splat.g = color.y, splat.b = color.z;
  out.tile_counts[i] = count;
  int32_t* r = out.rects + 4 * i;
  r[0] = rect.x0, r[1] = rect.y0, r[2] = rect.x1, r[3] = rect.y1;
  std::memcpy(out.splats + kSplatValues * i, &splat, sizeof splat);
}

template <class T>
void zero_row(T* rows, int64_t i, int64_t row) {
  if (rows) std::memset(rows + row * i, 0, row * sizeof(T));
}

template <class T>
void zero_gradient(const Scene<T>& s, int64_t i, const SceneGradient<T>& out) {
  zero_row(out.means, i, 3), zero_row(out.means2d, i, 3), zero_row(out.opacities, i, 1);
  zero_row(out.scales, i, 3), zero_row(out.rotations, i, 4), zero_row(out.cov3d, i, 6);
  zero_row(out.colors, i, 3), zero_row(out.sh_dc, i, 3), zero_row(out.sh_rest, i, 3 * s.rest_bands);
}

// Gradients of the coefficients and, returned, of the mean through the viewing direction.
template <class T>
Vec3<T> color_vjp(const Scene<T>& s, const Camera<T>& camera, int64_t i, Vec3<T> mean, Vec3<T> g,
                  const SceneGradient<T>& out) {
  constexpr int kCount = sh_count(kMaxShDegree);
  T basis[kCount], weight[kCount];
  Vec3<T> direction;
  const T norm = sh_direction(mean - camera.center, direction);
  sh_basis(s.sh_degree, direction, basis);
  const Vec3<T> c = unclamped_color(s, i, basis);
  g = {c.x > 0 ? g.x : T(0), c.y > 0 ? g.y : T(0), c.z > 0 ? g.z : T(0)};
  const int active = sh_count(s.sh_degree);
  const T* rest = s.sh_rest + s.rest_stride * i;
  for (int k = 1; k < active; ++k) weight[k] = dot(load3(rest + 3 * (k - 1)), g);
  if (out.sh_dc) store3(out.sh_dc + 3 * i, basis[0] * g);
  if (out.sh_rest) {
    T* row = out.sh_rest + 3 * s.rest_bands * i;
    for (int k = 1; k < active; ++k) store3(row + 3 * (k - 1), basis[k] * g);
    std::memset(row + 3 * (active - 1), 0, 3 * (s.rest_bands + 1 - active) * sizeof(T));
  }
  return sh_direction_vjp(direction, norm, sh_basis_vjp(s.sh_degree, direction, weight));
}

template <class T>
void project_vjp_one(const Scene<T>& s, const Camera<T>& camera, int64_t i, const T* m, const SceneGradient<T>& out) {
  const Loaded<T> in = load(s, i);
  const GaussianGradient<T> g = project_splat_vjp(camera, in.gaussian, s.antialiasing, out.cov3d != nullptr,
                                                  Moments<T>{m[0], m[1], m[2], m[3], m[4], m[5]}, m[9]);
  Vec3<T> g_mean = g.mean;
  const Vec3<T> g_color = {m[6], m[7], m[8]};
  if (s.colors) {
    if (out.colors) store3(out.colors + 3 * i, g_color);
  } else {
    g_mean = g_mean + color_vjp(s, camera, i, in.gaussian.mean, g_color, out);
  }
  if (out.means) store3(out.means + 3 * i, g_mean);
  if (out.means2d)
    store3(out.means2d + 3 * i,
           Vec3<T>{g.pixel_x * T(0.5) * T(s.image.width), g.pixel_y * T(0.5) * T(s.image.height), T(0)});
  if (out.opacities)
    out.opacities[i] = g.log_opacity * (s.raw ? log_sigmoid_slope(s.opacities[i]) : 1 / s.opacities[i]);
  if (out.scales)
    for (int k = 0; k < 3; ++k)
      out.scales[3 * i + k] = g.scale[k] * (s.raw ? in.gaussian.axes.scale[k] : s.scale_modifier);
  if (out.rotations) {
    Quat<T> q = rotation_columns_vjp(in.rotation, g.direction);
    if (s.raw) q = normalise_vjp(in.rotation, in.rotation_norm, q);
    T* row = out.rotations + 4 * i;
    row[0] = q.w, row[1] = q.x, row[2] = q.y, row[3] = q.z;
  }
  if (out.cov3d) std::memcpy(out.cov3d + 6 * i, g.covariance, sizeof g.covariance);
}

}  // namespace

template <class T>
void project(const Executor& executor, const Scene<T>& s, const Projected<T>& out) {
  const Camera<T> camera = camera_of(s);
  for_dynamic(executor, s.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) project_one(s, camera, i, out);
  });
}

template <class T>
void project_vjp(const Executor& executor, const Scene<T>& s, const int32_t* tile_counts, const T* moments,
                 const SceneGradient<T>& out) {
  const Camera<T> camera = camera_of(s);
  for_dynamic(executor, s.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      if (tile_counts[i])
        project_vjp_one(s, camera, i, moments + kGradientValues * i, out);
      else
        zero_gradient(s, i, out);
  });
}

template <class T>
void mark_visible(const Executor& executor, int64_t count, const T* means, const T* view, bool* visible) {
  const Vec3<T> row_z = {view[2], view[6], view[10]};
  for_dynamic(executor, count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) visible[i] = in_front(dot(row_z, load3(means + 3 * i)) + view[14]);
  });
}

#define GS_INSTANTIATE(T)                                                                                            \
  template void project<T>(const Executor&, const Scene<T>&, const Projected<T>&);                                   \
  template void project_vjp<T>(const Executor&, const Scene<T>&, const int32_t*, const T*, const SceneGradient<T>&); \
  template void mark_visible<T>(const Executor&, int64_t, const T*, const T*, bool*);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
