#pragma once
// Where density control puts the children of a split Gaussian (Kerbl et al. 2023, section 5.2).
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

// The centre of child `i`: its parent's mean plus R e, where e is normal with the parent's scales.
GS_HD void split_position(const SplitInput& in, int64_t i) {
  double e[4];
  normals(philox({{uint32_t(in.items[i]), in.draw, in.iteration, in.stream}}, in.seed), e);
  for (int k = 0; k < 3; ++k) e[k] = rounded_product(e[k], portable::exp(in.log_scales[3 * i + k]));
  const Offset offset = rotated(in.rotations + 4 * i, {e[0], e[1], e[2]});
  in.positions[3 * i] = float(in.means[3 * i] + offset.x);
  in.positions[3 * i + 1] = float(in.means[3 * i + 1] + offset.y);
  in.positions[3 * i + 2] = float(in.means[3 * i + 2] + offset.z);
}

}  // namespace gs
