// The backward of projection, and of the whole rasterizer. A thread takes a Gaussian.
#include <cuda_runtime.h>

#include "../backend.h"
#include "../math/scene_row.h"
#include "gradient_rows.cuh"
#include "sh_rows.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 128;

// A source of moments for project_vjp_kernel, as SlotSums is: moments that were summed before.
struct StoredMoments {
  const float* moments;
  const int32_t* tile_counts;
  __device__ bool seen(int64_t i) const { return tile_counts[i] != 0; }
  __device__ void read(int64_t i, bool wanted, float* m, float* /*stage*/) const {
    for (int v = 0; wanted && v < kGradientValues; ++v) m[v] = moments[kGradientValues * i + v];
  }
};

template <class Source>
__global__ void __launch_bounds__(kThreads)
    project_vjp_kernel(const int32_t* halted, Scene<float> s, Source source, SceneGradient<float> out) {
  if (is_halted(halted)) return;
  __shared__ Camera<float> camera;
  __shared__ __align__(16) float rest[kThreads * kRest];
  __shared__ __align__(8) float stage[kThreads / 32 * SlotSums::kStage];
  if (threadIdx.x == 0) camera = camera_of(s);
  __syncthreads();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, first = i - (threadIdx.x & 31);
  const bool seen = i < s.count && source.seen(i);
  float* row = rest + threadIdx.x * kRest;
  float* warp_rows = rest + (threadIdx.x & ~31) * kRest;
  if (!s.colors)
    fetch_rows(s.sh_rest, first, s.count, s.rest_stride, 3 * (sh_count(s.sh_degree) - 1), __ballot_sync(kWarp, seen), 0,
               warp_rows);
  float m[kGradientValues];
  source.read(i, seen, m, stage + threadIdx.x / 32 * SlotSums::kStage);
  wait_for_rows();
  if (seen) {
    // Writes the row even if it is not wanted: a null pointer would be tested for every band.
    project_vjp_row(s, camera, i, m, row, row, out);
  } else if (i < s.count) {
    zero_gradient(i, out);
    for (int k = 0; k < 3 * s.rest_bands; ++k) row[k] = 0;
  }
  if (out.sh_rest && first < s.count)
    write_rows(warp_rows, first, int(s.count - first < 32 ? s.count - first : 32), 3 * s.rest_bands, out.sh_rest);
}

template <class Source>
void launch_project_vjp(const Queue& queue, const Scene<float>& s, const Source& source,
                        const SceneGradient<float>& out) {
  project_vjp_kernel<<<blocks_for(s.count, kThreads), kThreads, 0, stream_of(queue)>>>(queue.halted, s, source, out);
  check_launch("project_vjp");
}

}  // namespace

template <>
void project_vjp<float>(const Queue& queue, const Scene<float>& s, const int32_t* tile_counts, const float* moments,
                        const SceneGradient<float>& out) {
  if (s.count) launch_project_vjp(queue, s, StoredMoments{moments, tile_counts}, out);
}

void rasterize_vjp(const Queue& queue, const Scene<float>& s, const BlendInput<float>& in,
                   const BlendGradient<float>& g, const GradientMemory& memory) {
  if (!s.count) return;
  const SlotSums source{blend_rows(queue, in, g), g.slots};
  launch_project_vjp(queue, s, source, memory.take(memory.context));
}

}  // namespace cuda
}  // namespace gs
