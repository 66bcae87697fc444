// The gradient of the camera: blocks of Gaussians are summed by threads, and their sums one after the other.
#include <vector>

#include "../backend.h"
#include "../math/camera_gradient.h"
#include "../math/splat.h"

GS_ISA_BEGIN

template <class T>
void camera_vjp(const Executor& executor, const Scene<T>& s, const int32_t* tile_counts, const T* moments,
                double* out) {
  with_camera(s, [&](const auto& camera) {
    constexpr int kNumbers = kNumbersOf<std::decay_t<decltype(camera)>>;
    std::vector<double> sums(kNumbers * sleep_blocks(s.count), 0);
    for_dynamic(executor, s.count, kSleepBlock, [&](int64_t begin, int64_t end) {
      double* sum = sums.data() + kNumbers * (begin / kSleepBlock);
      for (int64_t i = begin; i < end; ++i) {
        if (!tile_counts[i]) continue;
        T g[kNumbers];
        camera_vjp_row(s, camera, SceneRow<T>{s, i}, moments + kGradientValues * i, g);
        for (int k = 0; k < kNumbers; ++k) sum[k] += g[k];
      }
    });
    for (int k = 0; k < kNumbers; ++k) {
      out[k] = 0;
      for (int64_t block = 0; block < sleep_blocks(s.count); ++block) out[k] += sums[kNumbers * block + k];
    }
  });
}

template void camera_vjp<float>(const Executor&, const Scene<float>&, const int32_t*, const float*, double*);
template void camera_vjp<double>(const Executor&, const Scene<double>&, const int32_t*, const double*, double*);

GS_ISA_END
