// Describes splats by the values that programs for gsplat read. A thread takes a splat.
#include <cuda_runtime.h>

#include "../backend.h"
#include "../math/describe.h"
#include "queue.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads)
    describe_kernel(const int32_t* halted, DescribeInput<float> in, Descriptions<float> out) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.count) baseline::describe_splat(in, out, i);
}

}  // namespace

void describe(const Queue& queue, const DescribeInput<float>& in, const Descriptions<float>& out) {
  if (in.count) launch(queue, "describe", describe_kernel, blocks_for(in.count, kThreads), kThreads, in, out);
}

}  // namespace cuda
}  // namespace gs
