#pragma once
// Random moves of Gaussians within their own shape: to the children of split ones (Kerbl et al. 2023, section 5.2), and
// by the noise by which they explore (Kheradmand et al. 2024, section 3.2).
#include "../data.h"
#include "random.h"

namespace gs {

template <class T>
struct Offset {
  T x, y, z;
};

template <class T>
GS_HD Offset<T> rounded_cross(const Offset<T>& a, const Offset<T>& b) {
  return {rounded_product(a.y, b.z) - rounded_product(a.z, b.y), rounded_product(a.z, b.x) - rounded_product(a.x, b.z),
          rounded_product(a.x, b.y) - rounded_product(a.y, b.x)};
}

// A rotation: a quaternion (w, u) of unit length.
template <class T>
struct Rotation {
  T w;
  Offset<T> u;

  // q: (w, x, y, z) of any length. In float its squares may overflow or vanish, so it is scaled first.
  GS_HD explicit Rotation(const float* q) {
    T scaled[4], square = 0, unit = 1;
    if constexpr (sizeof(T) == sizeof(float)) {
      unit = T(1e-12);
      for (int k = 0; k < 4; ++k) unit = std::abs(q[k]) > unit ? std::abs(q[k]) : unit;
    }
    for (int k = 0; k < 4; ++k) scaled[k] = q[k] / unit, square += rounded_product(scaled[k], scaled[k]);
    const T root = std::sqrt(square), least = T(1e-12) / unit, length = root < least ? least : root;
    w = scaled[0] / length, u = {scaled[1] / length, scaled[2] / length, scaled[3] / length};
  }

  GS_HD Rotation back() const {
    Rotation inverse = *this;
    inverse.u = {-u.x, -u.y, -u.z};
    return inverse;
  }

  // v + 2 w (u x v) + 2 u x (u x v).
  GS_HD Offset<T> of(const Offset<T>& v) const {
    const Offset<T> once = rounded_cross(u, v), twice = {once.x * 2, once.y * 2, once.z * 2};
    const Offset<T> more = rounded_cross(u, twice);
    return {(v.x + rounded_product(w, twice.x)) + more.x, (v.y + rounded_product(w, twice.y)) + more.y,
            (v.z + rounded_product(w, twice.z)) + more.z};
  }
};

// Moves the mean of parent `i` to its child: by R e, where e is normal with the parent's scales.
GS_HD void split_position(const Displacement& in, int64_t i) {
  double e[4];
  normals(philox({{uint32_t(in.items[i]), in.draw, in.iteration, in.stream}}, in.seed), e);
  for (int k = 0; k < 3; ++k) e[k] = rounded_product(e[k], portable::exp(double(in.log_scales[3 * i + k])));
  const Offset<double> offset = Rotation<double>(in.rotations + 4 * i).of({e[0], e[1], e[2]});
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
  const float opacity = 1 / (1 + portable::exp(-in.logits[i]));
  const float above = rounded_product(float(in.steepness), opacity - float(in.threshold));
  const float size = float(in.size) / (1 + portable::exp(above));
  float n[4];
  normals(philox({{uint32_t(in.first + i), 0, in.iteration, in.stream}}, in.seed), n);
  const Rotation<float> rotation(in.rotations + 4 * i);
  const Offset<float> own = rotation.back().of({n[0], n[1], n[2]});
  float e[3] = {own.x, own.y, own.z};
  for (int k = 0; k < 3; ++k) e[k] = rounded_product(e[k], portable::exp(2 * in.log_scales[3 * i + k]));
  const Offset<float> offset = rotation.of({e[0], e[1], e[2]});
  float* mean = in.means + 3 * i;
  const float x = mean[0] + rounded_product(size, offset.x), y = mean[1] + rounded_product(size, offset.y),
              z = mean[2] + rounded_product(size, offset.z);
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
