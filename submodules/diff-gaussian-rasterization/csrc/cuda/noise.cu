// Adds noise to the centres of Gaussians. A thread takes a Gaussian.
#include <cuda_runtime.h>

#include "../backend.h"
#include "../math/noise.h"
#include "queue.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) noise_kernel(const int32_t* halted, NoiseInput in) {
  if (is_halted(halted) || (in.stopped && *in.stopped)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.count) add_noise_to(in, i);
}

}  // namespace

void add_noise(const Queue& queue, const NoiseInput& in) {
  if (!in.count) return;
  noise_kernel<<<blocks_for(in.count, kThreads), kThreads, 0, stream_of(queue)>>>(queue.halted, in);
  check_launch("add_noise");
}

}  // namespace cuda
}  // namespace gs
