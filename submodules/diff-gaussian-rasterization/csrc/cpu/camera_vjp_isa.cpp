// The gradient of the camera, of blocks of Gaussians, which threads share.
#include <algorithm>

#include "../math/camera_gradient.h"
#include "project_vjp_rows.h"

GS_ISA_BEGIN

namespace {

// Adds what a block's Gaussians have: a pinhole's, a vector of them at a time.
template <class T>
void add_rows(const Scene<T>& s, const Camera<T>& camera, const int32_t* tile_counts, const T* moments, double* sum) {
  using V = typename Simd<T>::Vec;
  int32_t seen[kVjpBlock];
  for_packs<T>(seen, list_seen(s, tile_counts, {}, seen), [&](const Pack<T>& pack) {
    V m[kGradientValues], rest[kMostRest], g[kPinholeNumbers];
    read_rows(moments, kGradientValues, s.count, kGradientValues, pack, m);
    SceneLanes<T> row(s, pack);
    row.read_colors(s, pack, rest);
    camera_vjp_row(s, camera, row, m, rest, g);
    for (int k = 0; k < kPinholeNumbers; ++k)
      for (int lane = 0; lane < pack.count; ++lane) sum[k] += g[k][lane];
  });
}

template <class T>
void add_rows(const Scene<T>& s, const LensCamera<T>& camera, const int32_t* tile_counts, const T* moments,
              double* sum) {
  for (int64_t i = 0; i < s.count; ++i) {
    if (!tile_counts[i]) continue;
    T g[kLensCameraNumbers];
    camera_vjp_row(s, camera, SceneRow<T>{s, i}, moments + kGradientValues * i, s.sh_rest + s.rest_stride * i, g);
    for (int k = 0; k < kLensCameraNumbers; ++k) sum[k] += g[k];
  }
}

}  // namespace

template <class T>
void camera_vjp(const Executor& executor, const Scene<T>& s, const int32_t* tile_counts, const T* moments,
                double* sums) {
  with_camera(s, [&](const auto& camera) {
    constexpr int kNumbers = kNumbersOf<std::decay_t<decltype(camera)>>;
    for_dynamic(executor, s.count, kVjpBlock, [&](int64_t begin, int64_t end) {
      double* const sum = sums + kNumbers * (begin / kVjpBlock);
      std::fill_n(sum, kNumbers, 0.0);
      add_rows(part_of(s, begin, end - begin), camera, tile_counts + begin, from_moments(s, moments, begin), sum);
    });
  });
}

template void camera_vjp<float>(const Executor&, const Scene<float>&, const int32_t*, const float*, double*);
template void camera_vjp<double>(const Executor&, const Scene<double>&, const int32_t*, const double*, double*);

GS_ISA_END
