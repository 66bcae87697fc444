// The gradient of the camera. A thread takes a Gaussian, a block sums what its threads have, and one more block for
// each number sums what the blocks have, in an order that depends on the number of Gaussians alone.
#include <cuda_runtime.h>

#include "../backend.h"
#include "../math/camera_gradient.h"
#include "awake.cuh"
#include "gradient_rows.cuh"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

constexpr int kThreads = kSleepBlock;
constexpr int kWarps = kThreads / 32;

// Sums a value over the threads of a block, for thread 0. All threads call this; `stage` has a double for each warp.
__device__ double block_sum(double value, double* stage) {
  for (int step = 16; step; step /= 2) value += __shfl_xor_sync(kWarp, value, step);
  __syncthreads();  // the values before have been read
  if (threadIdx.x % 32 == 0) stage[threadIdx.x / 32] = value;
  __syncthreads();
  double sum = 0;
  for (int warp = 0; warp < kWarps; ++warp) sum += stage[warp];
  return sum;
}

// sums (blocks, numbers): those of blocks that sleep are not written.
template <class AnyCamera>
__global__ void __launch_bounds__(kThreads)
    camera_vjp_kernel(const int32_t* halted, Scene<float> s, SlotSums<false> source, double* sums) {
  if (!begin_work(halted)) return;
  const int64_t block = awake_block(s, blockIdx.x);
  if (block < 0) return;
  constexpr int kNumbers = kNumbersOf<AnyCamera>;
  __shared__ AnyCamera camera;
  __shared__ __align__(8) float stage[kWarps * SlotSums<false>::kStage];
  __shared__ double of_warps[kWarps];
  if (threadIdx.x == 0) set_camera(s, camera);
  __syncthreads();
  const int64_t i = block * kThreads + threadIdx.x;
  const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x;  // in what the forward has made
  const bool seen = i < s.count && source.seen(at);
  float m[kGradientValues], g[kNumbers] = {};
  source.read(at, seen, m, stage + threadIdx.x / 32 * SlotSums<false>::kStage);
  if (seen) camera_vjp_row(s, camera, SceneRow<float>{s, i}, m, s.sh_rest + s.rest_stride * i, g);
#pragma unroll
  for (int k = 0; k < kNumbers; ++k) {
    const double sum = block_sum(g[k], of_warps);
    if (threadIdx.x == 0) sums[kNumbers * block + k] = sum;
  }
}

__global__ void __launch_bounds__(kThreads)
    sum_blocks_kernel(const int32_t* halted, int64_t blocks, const double* sums, double* out) {
  if (!begin_work(halted)) return;
  __shared__ double of_warps[kWarps];
  double sum = 0;
  for (int64_t block = threadIdx.x; block < blocks; block += kThreads) sum += sums[gridDim.x * block + blockIdx.x];
  sum = block_sum(sum, of_warps);
  if (threadIdx.x == 0) out[blockIdx.x] = sum;
}

template <class AnyCamera>
void sum_rows(const Queue& queue, const Scene<float>& s, const SlotSums<false>& source, double* out) {
  constexpr int kNumbers = kNumbersOf<AnyCamera>;
  const int64_t blocks = sleep_blocks(s.count);
  const size_t values = size_t(kNumbers) * blocks;
  double* sums = queue.array<double>(values);
  if (s.blocks || s.awake) GS_CUDA_CHECK(cudaMemsetAsync(sums, 0, values * sizeof *sums, stream_of(queue)));
  if (s.rows()) {
    const unsigned launched = blocks_for(s.rows(), kThreads);
    launch(queue, "camera_vjp", camera_vjp_kernel<AnyCamera>, launched, kThreads, s, source, sums);
  }
  launch(queue, "sum_blocks", sum_blocks_kernel, kNumbers, kThreads, blocks, sums, out);
}

}  // namespace

void camera_vjp(const Queue& queue, const Scene<float>& s, const SlotSums<false>& source, double* out) {
  if (s.lens.chart == Chart::kPinhole)
    sum_rows<Camera<float>>(queue, s, source, out);
  else
    sum_rows<LensCamera<float>>(queue, s, source, out);
}

void camera_vjp(const Queue& queue, const Scene<float>& s, const SplatRows<float>& in, double* out) {
  camera_vjp(queue, s, sums_of<false>(queue, in, {}), out);
}

}  // namespace cuda
}  // namespace gs
