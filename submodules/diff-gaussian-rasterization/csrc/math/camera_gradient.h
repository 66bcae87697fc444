#pragma once
// What one Gaussian, or each of several side by side, adds to the gradient of each number of a camera.
#include "scene_row.h"

GS_ISA_BEGIN

// The numbers of a camera and where their gradients lie: those of any camera, then a pinhole's own or a lens's.
// diff_gaussian_rasterization/camera.py makes them of the settings.
constexpr int kRowX = 0, kRowY = 3, kRowZ = 6, kTranslation = 9, kCenter = 12;
constexpr int kRays = 15;  // ray_min_x, ray_max_x, ray_min_y, ray_max_y
constexpr int kFocal = 19, kAxis = 21;
constexpr int kMeanFocal = 23, kPinholeNumbers = 25;
constexpr int kRadial = 23, kDivisor = 27, kTangential = 30, kPrism = 32, kLensCameraNumbers = 34;

template <class T>
GS_HD constexpr int numbers_of(const Camera<T>*) {
  return kPinholeNumbers;
}
template <class T>
GS_HD constexpr int numbers_of(const LensCamera<T>*) {
  return kLensCameraNumbers;
}
template <class AnyCamera>
constexpr int kNumbersOf = numbers_of(static_cast<const AnyCamera*>(nullptr));
template <class T>
GS_HD int camera_numbers(const Scene<T>& s) {
  return s.lens.chart == Chart::kPinhole ? kPinholeNumbers : kLensCameraNumbers;
}

// Adds up what blocks of kSleepBlock Gaussians have, (blocks, numbers), one after the other. A GPU has another order.
inline void sum_blocks(int64_t blocks, int64_t numbers, const double* sums, double* out) {
  for (int64_t k = 0; k < numbers; ++k) {
    out[k] = 0;
    for (int64_t block = 0; block < blocks; ++block) out[k] += sums[numbers * block + k];
  }
}

// The gradients of a splat that reach its camera. p1, p2: of the rows of J W, in the world.
template <class V>
struct Arriving {
  Footprint<V> footprint;
  ShapeGradient<V> shape;
  Vec3<V> p1, p2;
  V pixel[2], inverse_depth;
};

// Of what J adds to the gradients, those of the limits of a clamped coordinate: all of it, for the limit that holds.
template <class V>
GS_HD void limits_vjp(V apart, V g, V* limits) {
  limits[0] = apart > 0 ? g : V{}, limits[1] = apart < 0 ? g : V{};
}

// A camera's own numbers and its rows in J W; returns the gradient of the point of the view.
template <class T, class V>
GS_HD Vec3<V> numbers_vjp(const Camera<T>& cam, Vec3<V>, const Perspective<V>& p, const Along<V>& along,
                          const Arriving<V>& in, V* g) {
  const V fx = cam.focal_x * p.inverse_depth, fy = cam.focal_y * p.inverse_depth;
  store3(g + kRowX, fx * in.p1), store3(g + kRowY, fy * in.p2);
  store3(g + kRowZ, (-fx * p.clamped_x) * in.p1 - (fy * p.clamped_y) * in.p2);
  limits_vjp(p.clamped_x - p.ray_x, -fx * along.one, g + kRays);
  limits_vjp(p.clamped_y - p.ray_y, -fy * along.two, g + kRays + 2);
  g[kFocal] = dot(in.shape.m1, in.footprint.m1) / cam.focal_x;
  g[kFocal + 1] = dot(in.shape.m2, in.footprint.m2) / cam.focal_y;
  g[kAxis] = in.pixel[0], g[kAxis + 1] = in.pixel[1];
  g[kMeanFocal] = in.pixel[0] * p.ray_x, g[kMeanFocal + 1] = in.pixel[1] * p.ray_y;
  return p.inverse_depth * view_vjp(cam, p, along, in.shape.diagonal, in.pixel[0], in.pixel[1], in.inverse_depth);
}

// A lens's numbers: through the pixel of `view`, and through the lens's Jacobian at `clamped`. With by[i] the gradient
// of distorted number i's derivatives by a and b, a factor h(q) of both numbers, whose coefficient is wanted, gets
// sum_i pixel_i x_i h + by[i][i] h + 2 h' x_i (by[i][0] a + by[i][1] b); pixels and `by` times the focal lengths.
template <class T>
GS_HD void lens_vjp(const Lens<T>& lens, Vec3<T> view, Vec3<T> clamped, const AlongAxes<T>& along, const T (&pixel)[2],
                    T* g) {
  const OnLens<T> at = on_chart(lens.chart, view), near = on_chart(lens.chart, clamped);
  const T a = at.value[0], b = at.value[1], u = near.value[0], v = near.value[1];
  const Distorted<T> d = distort(lens, a, b), e = distort(lens, u, v);
  T by[2][2] = {}, px[2];
  for (int i = 0; i < 2; ++i) {
    for (int j = 0; j < 2; ++j)
      for (int k = 0; k < 3; ++k) by[i][j] += along.of[i][k] * near.first[j][k];
    g[kFocal + i] = pixel[i] * d.value[i] + by[i][0] * e.first[i][0] + by[i][1] * e.first[i][1];
    g[kAxis + i] = pixel[i];
    const T focal = i ? lens.focal_y : lens.focal_x;
    px[i] = focal * pixel[i], by[i][0] *= focal, by[i][1] *= focal;
  }
  const T q = a * a + b * b, s = u * u + v * v;
  const T in_pixel = px[0] * a + px[1] * b, in_first = by[0][0] + by[1][1];
  const T in_slope = 2 * (u * (by[0][0] * u + by[0][1] * v) + v * (by[1][0] * u + by[1][1] * v));
  const Radial<T> far = radial_of(lens, q), close = radial_of(lens, s);
  // The factor q^j / divisor; for a coefficient of the divisor, times -R.
  T power = 1, power_close = 1;
  for (int j = 1; j <= 4; ++j) {
    const T before = power_close;
    power *= q, power_close *= s;
    const T h = power / far.divisor, h_close = power_close / close.divisor;
    const T slope = (j * before - h_close * close.divisor1) / close.divisor;
    g[kRadial + j - 1] = in_pixel * h + in_first * h_close + in_slope * slope;
    if (j < 4)
      g[kDivisor + j - 1] =
          -(in_pixel * far.r * h + in_first * close.r * h_close + in_slope * (close.r * slope + close.r1 * h_close));
  }
  g[kTangential] =
      px[0] * 2 * a * b + px[1] * (q + 2 * b * b) + 2 * (by[0][0] * v + by[0][1] * u + by[1][0] * u + 3 * by[1][1] * v);
  g[kTangential + 1] =
      px[0] * (q + 2 * a * a) + px[1] * 2 * a * b + 2 * (3 * by[0][0] * u + by[0][1] * v + by[1][0] * v + by[1][1] * u);
  g[kPrism] = px[0] * q + 2 * (by[0][0] * u + by[0][1] * v);
  g[kPrism + 1] = px[1] * q + 2 * (by[1][0] * u + by[1][1] * v);
}

template <class T>
GS_HD Vec3<T> numbers_vjp(const LensCamera<T>& cam, Vec3<T> view, const LensView<T>& p, const AlongAxes<T>& along,
                          const Arriving<T>& in, T* g) {
  T bent[3] = {};
  const Vec3<T> g_view = view_vjp(cam, view, p, along, in.pixel[0], in.pixel[1], in.inverse_depth, bent);
  const OnLens<T> there = on_lens<1>(cam.lens, p.clamped);
  for (int k = 0; k < 3; ++k) store3(g + kRowX + 3 * k, there.first[0][k] * in.p1 + there.first[1][k] * in.p2);
  limits_vjp(p.clamped.x - view.x, bent[0] * view.z, g + kRays);
  limits_vjp(p.clamped.y - view.y, bent[1] * view.z, g + kRays + 2);
  lens_vjp(cam.lens, view, p.clamped, along, in.pixel, g);
  return g_view;
}

// m, rest: as for project_vjp_row. g (kNumbersOf<AnyCamera>): what the Gaussian adds.
template <class T, class AnyCamera, class Row, class V = typename Row::Number>
GS_HD void camera_vjp_row(const Scene<T>& s, const AnyCamera& camera, const Row& row, const V* m, const V* rest, V* g) {
  const Gaussian<V> gaussian = load(s, row).gaussian;
  const Vec3<V> mean = gaussian.mean, view = to_view(camera, mean);
  const auto p = perspective(camera, view);
  const Moments<V> moments = moments_of(m);
  Arriving<V> in;
  in.footprint = splat_footprint(camera, p, gaussian.axes);
  in.inverse_depth = m[9];
  mean_vjp(in.footprint, moments, in.pixel[0], in.pixel[1]);
  in.shape = footprint_vjp(in.footprint, moments, s.antialiasing);
  const Vec3<V> m1 = in.shape.m1, m2 = in.shape.m2;
  const auto& d = gaussian.axes.direction;
  const auto& c = gaussian.axes.scale;
  in.p1 = (c[0] * m1.x) * d[0] + (c[1] * m1.y) * d[1] + (c[2] * m1.z) * d[2];
  in.p2 = (c[0] * m2.x) * d[0] + (c[1] * m2.y) * d[1] + (c[2] * m2.z) * d[2];
  const V row1[3] = {m1.x, m1.y, m1.z}, row2[3] = {m2.x, m2.y, m2.z};
  const Vec3<V> g_view = numbers_vjp(camera, view, p, along_view(camera, gaussian.axes, row1, row2), in, g);
  store3(g + kRowX, load3(g + kRowX) + g_view.x * mean);
  store3(g + kRowY, load3(g + kRowY) + g_view.y * mean);
  store3(g + kRowZ, load3(g + kRowZ) + g_view.z * mean);
  store3(g + kTranslation, g_view);
  Vec3<V> toward = {};
  V* const none = nullptr;
  if (!s.colors) toward = color_vjp(s, camera, row, Vec3<V>{m[6], m[7], m[8]}, rest, none, none);
  store3(g + kCenter, T(-1) * toward);
}

GS_ISA_END
