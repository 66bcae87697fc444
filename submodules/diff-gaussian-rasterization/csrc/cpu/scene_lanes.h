#pragma once
// The Gaussians of a block, and a vector of them at a time.
#include "../math/scene_row.h"
#include "row_lanes.h"

GS_ISA_BEGIN

template <class T>
T* from_row(T* rows, int64_t first, int64_t row) {
  return rows ? rows + first * row : nullptr;
}

// The Gaussians [first, first + count) of a scene.
template <class T>
Scene<T> part_of(Scene<T> s, int64_t first, int64_t count) {
  s.count = count;
  s.means = from_row(s.means, first, 3), s.opacities = from_row(s.opacities, first, 1);
  s.scales = from_row(s.scales, first, 3), s.rotations = from_row(s.rotations, first, 4);
  s.cov3d = from_row(s.cov3d, first, 6), s.colors = from_row(s.colors, first, 3);
  s.sh_dc = from_row(s.sh_dc, first, s.dc_stride), s.sh_rest = from_row(s.sh_rest, first, s.rest_stride);
  return s;
}

// The values of sh_rest that a colour reads.
template <class T>
int active_rest(const Scene<T>& s) {
  return s.colors ? 0 : 3 * (sh_count(s.sh_degree) - 1);
}
constexpr int kMostRest = 3 * (sh_count(kMaxShDegree) - 1);

template <class T>
Vec3<typename Simd<T>::Vec> read_means(const Scene<T>& s, const Pack<T>& pack) {
  typename Simd<T>::Vec v[3];
  read_rows(s.means, 3, s.count, 3, pack, v);
  return load3(v);
}

// The parameters of a pack's Gaussians, for the functions of math/scene_row.h.
template <class T>
class SceneLanes {
 public:
  using Number = typename Simd<T>::Vec;

  SceneLanes(const Scene<T>& s, const Pack<T>& pack) : mean_(read_means(s, pack)) {
    read_rows(s.opacities, 1, s.count, 1, pack, &opacity_);
    if (s.cov3d) {
      read_rows(s.cov3d, 6, s.count, 6, pack, shape_);
    } else {
      read_rows(s.scales, 3, s.count, 3, pack, shape_);
      read_rows(s.rotations, 4, s.count, 4, pack, shape_ + 3);
    }
  }

  // Reads what colours come from: the base, and to `rest` (kMostRest) the other coefficients.
  void read_colors(const Scene<T>& s, const Pack<T>& pack, Number* rest) {
    if (s.colors)
      read_rows(s.colors, 3, s.count, 3, pack, base_);
    else
      read_rows(s.sh_dc, s.dc_stride, s.count, 3, pack, base_);
    read_rows(s.sh_rest, s.rest_stride, s.count, active_rest(s), pack, rest);
  }

  Vec3<Number> mean() const { return mean_; }
  Number opacity() const { return opacity_; }
  Number scale(int k) const { return shape_[k]; }
  Quat<Number> rotation() const { return {shape_[3], shape_[4], shape_[5], shape_[6]}; }
  const Number* cov3d() const { return shape_; }
  Vec3<Number> base() const { return load3(base_); }

 private:
  Vec3<Number> mean_;
  Number opacity_;
  Number shape_[7];  // scales, then rotation; or the covariance
  Number base_[3];
};

GS_ISA_END
