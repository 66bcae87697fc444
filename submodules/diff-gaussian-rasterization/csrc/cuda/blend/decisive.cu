// Marks the decisive splats. A thread takes a pixel; all threads of a tile read the same splat at the same time, so it
// comes from the cache. This runs once, at the end of a training, so it is simple rather than fast.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/project/splat_row.cuh"
#include "cuda/queue/queue.cuh"
#include "math/lens_pixels.h"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

template <int kRays>
__global__ void __launch_bounds__(kTile* kTile)
    decisive_kernel(BlendInput<float> in, const int32_t* last, bool* decisive) {
  const int across = tile_count(in.image.width), tile = blockIdx.x;
  const int left = tile % across * kTile, top = tile / across * kTile;
  const int column = threadIdx.x % kTile, row = threadIdx.x / kTile;
  if (left + column >= in.image.width || top + row >= in.image.height) return;
  const int64_t begin = in.ranges[tile], end = in.ranges[tile + 1];
  const int64_t blended = begin + last[int64_t(top + row) * in.image.width + left + column];
  for (int64_t k = begin; k < end; ++k) {
    const int32_t index = in.instances[k];
    const auto splat = load_shape<kRays>(in.splats, index);
    float t;
    if constexpr (kRays == kLensRays) {
      const float* place = places_of(in.table, in.image, tile) + kTile * row + column;
      t = exponent_at(lens_terms(splat, frame_at(in.table, tile)), Place<float>{place[0], place[kTile * kTile]});
    } else {
      const float from = unrolled(splat, float(left), in.image.width);
      t = exponent_at(row_terms(localise(splat, from, float(top)), float(row)), float(column));
    }
    if (!(t >= float(kLog2MinAlpha))) continue;
    decisive[index] = true;  // many threads write the same
    if (k >= blended) return;
  }
}

}  // namespace

template <>
void mark_decisive<float>(const Queue& queue, const BlendInput<float>& in, const int32_t* last, bool* decisive) {
  const auto kernel = by_rays(in.rays, [](auto rays) { return decisive_kernel<rays>; });
  kernel<<<unsigned(tiles_of(in.image)), kTile * kTile, 0, stream_of(queue)>>>(in, last, decisive);
  check_launch("decisive");
}

}  // namespace cuda
}  // namespace gs
