// The gradient of the camera. A thread takes a Gaussian, a block sums what its threads have, and one more block for
// each number sums what the blocks have, in an order that depends on the number of Gaussians alone.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/project/awake.cuh"
#include "gradient_rows.cuh"
#include "math/camera_gradient.h"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

constexpr int kThreads = kSleepBlock;
constexpr int kWarps = kThreads / 32;

// Sums numbers over the lanes of a warp, kCount a power of two up to 32: each exchange halves what a lane still sums.
// Returns the sum of number lane * kCount / 32.
template <int kCount>
__device__ double warp_sums(double (&v)[kCount]) {
#pragma unroll
  for (int step = 16, kept = kCount / 2; step; step /= 2, kept /= 2) {
    const bool upper = threadIdx.x & step;
    if (!kept) v[0] += __shfl_xor_sync(kWarp, v[0], step);
#pragma unroll
    for (int k = 0; k < kCount / 2; ++k) {
      if (k >= kept) break;
      const double other = __shfl_xor_sync(kWarp, upper ? v[k] : v[k + kept], step);
      v[k] = (upper ? v[k + kept] : v[k]) + other;
    }
  }
  return v[0];
}

// Sums numbers `first` to first + kCount of all lanes into the warp's row of them.
template <int kCount, int kNumbers>
__device__ void sum_numbers(const float (&g)[kNumbers], int first, double* row) {
  double v[kCount];
#pragma unroll
  for (int k = 0; k < kCount; ++k) v[k] = first + k < kNumbers ? double(g[first + k]) : 0.0;
  const double sum = warp_sums(v);
  const int lane = threadIdx.x % 32, number = first + lane * kCount / 32;
  if (lane % (32 / kCount) == 0 && number < kNumbers) row[number] = sum;
}

// sums (blocks, numbers): those of blocks that sleep are not written.
template <class AnyCamera, class Source>
__global__ void __launch_bounds__(kThreads)
    camera_vjp_kernel(const int32_t* halted, Scene<float> s, Source source, double* sums) {
  if (!begin_work(halted)) return;
  const int64_t block = awake_block(s, blockIdx.x);
  if (block < 0) return;
  constexpr int kNumbers = kNumbersOf<AnyCamera>;
  __shared__ AnyCamera camera;
  __shared__ __align__(8) float stage[kWarps * SlotSums<false>::kStage];
  __shared__ double of_warps[kWarps][kNumbers];
  if (threadIdx.x == 0) set_camera(s, camera);
  __syncthreads();
  const int warp = threadIdx.x / 32;
  const int64_t i = block * kThreads + threadIdx.x;
  const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x;  // in what the forward has made
  const bool seen = i < s.count && source.seen(at);
  float g[kNumbers] = {};
  if (__any_sync(kWarp, seen)) {
    float m[kGradientValues];
    source.read(at, seen, m, stage + warp * SlotSums<false>::kStage);
    if (seen) camera_vjp_row(s, camera, SceneRow<float>{s, i}, m, s.sh_rest + s.rest_stride * i, g);
  }
  sum_numbers<32>(g, 0, of_warps[warp]);
  if constexpr (kNumbers > 32) sum_numbers<2>(g, 32, of_warps[warp]);
  __syncthreads();
  if (threadIdx.x >= kNumbers) return;
  double sum = 0;
  for (int k = 0; k < kWarps; ++k) sum += of_warps[k][threadIdx.x];
  sums[kNumbers * block + threadIdx.x] = sum;
}

__global__ void __launch_bounds__(kThreads)
    sum_blocks_kernel(const int32_t* halted, int64_t blocks, const double* sums, double* out) {
  if (!begin_work(halted)) return;
  __shared__ double of_warps[kWarps];
  double sum[1] = {};
  for (int64_t block = threadIdx.x; block < blocks; block += kThreads) sum[0] += sums[gridDim.x * block + blockIdx.x];
  const double of_warp = warp_sums(sum);
  if (threadIdx.x % 32 == 0) of_warps[threadIdx.x / 32] = of_warp;
  __syncthreads();
  if (threadIdx.x) return;
  double all = 0;
  for (int k = 0; k < kWarps; ++k) all += of_warps[k];
  out[blockIdx.x] = all;
}

template <class Source>
void sum_rows(const Queue& queue, const Scene<float>& s, const Source& source, double* sums) {
  const size_t values = size_t(camera_numbers(s)) * sleep_blocks(s.count);
  if (s.blocks || s.awake) GS_CUDA_CHECK(cudaMemsetAsync(sums, 0, values * sizeof *sums, stream_of(queue)));
  if (!s.rows()) return;
  const auto kernel = s.lens.chart == Chart::kPinhole ? camera_vjp_kernel<Camera<float>, Source>
                                                      : camera_vjp_kernel<LensCamera<float>, Source>;
  launch(queue, "camera_vjp", kernel, blocks_for(s.rows(), kThreads), kThreads, s, source, sums);
}

}  // namespace

void sum_blocks(const Queue& queue, int64_t blocks, int64_t numbers, const double* sums, double* out) {
  launch(queue, "sum_blocks", sum_blocks_kernel, unsigned(numbers), kThreads, blocks, sums, out);
}

void camera_vjp(const Queue& queue, const Scene<float>& s, const SlotSums<false>& source, double* out) {
  const int64_t blocks = sleep_blocks(s.count), numbers = camera_numbers(s);
  double* sums = queue.array<double>(size_t(numbers) * blocks);
  sum_rows(queue, s, source, sums);
  sum_blocks(queue, blocks, numbers, sums, out);
}

void camera_vjp(const Queue& queue, const Scene<float>& s, const SplatRows<float>& in, double* sums) {
  sum_rows(queue, s, sums_of<false>(queue, in, {}), sums);
}

void camera_vjp(const Queue& queue, const Scene<float>& s, const int32_t* tile_counts, const float* moments,
                double* sums) {
  sum_rows(queue, s, StoredMoments<false>{moments, tile_counts}, sums);
}

}  // namespace cuda
}  // namespace gs
