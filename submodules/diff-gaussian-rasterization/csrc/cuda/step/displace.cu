// Moves Gaussians at random. A thread takes a Gaussian.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/queue/queue.cuh"
#include "math/displace.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) displace_kernel(const int32_t* halted, Displacement in) {
  if (!begin_work(halted) || (in.stopped && *in.stopped)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.count) gs::displace(in, i);
}

}  // namespace

void displace(const Queue& queue, const Displacement& in) {
  if (!in.count) return;
  launch(queue, "displace", displace_kernel, blocks_for(in.count, kThreads), kThreads, in);
}

}  // namespace cuda
}  // namespace gs
