#pragma once
// Random moves of Gaussians within their own shape: to the children of split ones (Kerbl et al. 2023, section 5.2), and
// by the noise by which they explore (Kheradmand et al. 2024, section 3.2).
#include "../data.h"
#include "random.h"

namespace gs {

struct Offset {
  double x, y, z;
};

GS_HD Offset rounded_cross(const Offset& a, const Offset& b) {
  return {rounded_product(a.y, b.z) - rounded_product(a.z, b.y), rounded_product(a.z, b.x) - rounded_product(a.x, b.z),
          rounded_product(a.x, b.y) - rounded_product(a.y, b.x)};
}

// v turned by a quaternion (w, x, y, z) of any length: v + 2 w (u x v) + 2 u x (u x v), with (w, u) of unit length.
GS_HD Offset rotated(const float* quaternion, const Offset& v) {
  double q[4], square = 0;
  for (int k = 0; k < 4; ++k) q[k] = quaternion[k], square += rounded_product(q[k], q[k]);
  const double root = std::sqrt(square), length = root < 1e-12 ? 1e-12 : root;
  const double w = q[0] / length;
  const Offset u = {q[1] / length, q[2] / length, q[3] / length}, once = rounded_cross(u, v);
  const Offset twice = {once.x * 2, once.y * 2, once.z * 2}, more = rounded_cross(u, twice);
  return {(v.x + rounded_product(w, twice.x)) + more.x, (v.y + rounded_product(w, twice.y)) + more.y,
          (v.z + rounded_product(w, twice.z)) + more.z};
}

// Moves the mean of parent `i` to its child: by R e, where e is normal with the parent's scales.
GS_HD void split_position(const Displacement& in, int64_t i) {
  double e[4];
  normals(philox({{uint32_t(in.items[i]), in.draw, in.iteration, in.stream}}, in.seed), e);
  for (int k = 0; k < 3; ++k) e[k] = rounded_product(e[k], portable::exp(in.log_scales[3 * i + k]));
  const Offset offset = rotated(in.rotations + 4 * i, {e[0], e[1], e[2]});
  float* mean = in.means + 3 * i;
  mean[0] = float(mean[0] + offset.x), mean[1] = float(mean[1] + offset.y), mean[2] = float(mean[2] + offset.z);
}

// Tells, for certain, that no noise can change the mean of Gaussian `i`: it would be rounded away. Then nobody needs to
// compute it. Most opaque Gaussians are such.
GS_HD bool noise_is_lost(const Displacement& in, int64_t i) {
  const float *x = in.means + 3 * i, *s = in.log_scales + 3 * i;
  const float widest = s[0] > s[1] ? (s[0] > s[2] ? s[0] : s[2]) : (s[1] > s[2] ? s[1] : s[2]);
  const float a = std::abs(x[0]), b = std::abs(x[1]), c = std::abs(x[2]);
  const float least = a < b ? (a < c ? a : c) : (b < c ? b : c);
  const float opacity = 1 / (1 + std::exp(-in.logits[i]));
  // The gate is at most e^(k (t - o)), and no three numbers of `normals` are longer than 9.5. What is missing to 16,
  // and to half a unit in the last place of the mean, is more than the rounding errors of this.
  const float gate = float(in.steepness) * (float(in.threshold) - opacity);
  return float(in.size) * 16 * std::exp(gate + 2 * widest) < least * 0x1p-26f;
}

// Moves the mean of Gaussian `i` by `size` g C n: C is its covariance, n is normal, g = 1 / (1 + e^(k (o - t))) with
// its opacity o, the steepness k and the threshold t. A mean that would not be finite stays.
GS_HD void add_noise_to(const Displacement& in, int64_t i) {
  if (noise_is_lost(in, i)) return;
  const double opacity = 1 / (1 + portable::exp(-double(in.logits[i])));
  const double above = rounded_product(in.steepness, opacity - in.threshold);
  const double size = in.size / (1 + portable::exp(above));
  double n[4];
  normals(philox({{uint32_t(in.first + i), 0, in.iteration, in.stream}}, in.seed), n);
  const float* q = in.rotations + 4 * i;
  const float back[4] = {q[0], -q[1], -q[2], -q[3]};
  const Offset own = rotated(back, {n[0], n[1], n[2]});
  double e[3] = {own.x, own.y, own.z};
  for (int k = 0; k < 3; ++k) e[k] = rounded_product(e[k], portable::exp(2 * double(in.log_scales[3 * i + k])));
  const Offset offset = rotated(q, {e[0], e[1], e[2]});
  float* mean = in.means + 3 * i;
  const float x = float(mean[0] + rounded_product(size, offset.x)),
              y = float(mean[1] + rounded_product(size, offset.y)),
              z = float(mean[2] + rounded_product(size, offset.z));
  if (std::isfinite(x) && std::isfinite(y) && std::isfinite(z)) mean[0] = x, mean[1] = y, mean[2] = z;
}

// Any of the two; nothing happens once `stopped` is not 0.
GS_HD void displace(const Displacement& in, int64_t i) {
  if (in.logits)
    add_noise_to(in, i);
  else
    split_position(in, i);
}

}  // namespace gs
