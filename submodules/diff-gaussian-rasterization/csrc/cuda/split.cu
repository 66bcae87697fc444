// Places the children of split Gaussians. A thread takes a child.
#include <cuda_runtime.h>

#include "../backend.h"
#include "../math/split.h"
#include "queue.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) split_kernel(SplitInput in) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.count) split_position(in, i);
}

}  // namespace

void split_positions(const Queue& queue, const SplitInput& in) {
  if (!in.count) return;
  split_kernel<<<blocks_for(in.count, kThreads), kThreads, 0, stream_of(queue)>>>(in);
  check_launch("split_positions");
}

}  // namespace cuda
}  // namespace gs
