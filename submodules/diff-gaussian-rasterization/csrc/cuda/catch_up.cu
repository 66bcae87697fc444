// Adam's steps without a gradient that rows have missed. The rows may lie in the host's memory.
#include <cuda_runtime.h>

#include "../backend.h"
#include "../math/adam.h"
#include "guarded_adam.cuh"
#include "queue.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) catch_up_kernel(AdamInput<float> in, MissedSteps<float> missed) {
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k >= in.rows * in.columns) return;
  const int64_t r = k / in.columns, i = r * in.row + k % in.columns;
  int32_t next = missed.taken[r];
  if (next >= missed.count) return;
  const auto* steps = reinterpret_cast<const AdamConstants*>(missed.constants);
  float value = in.value[i], mean = in.mean[i], square = in.square[i];
  for (; next < missed.count; ++next) step_value(true, steps[next], 0.0f, value, mean, square);
  in.value[i] = value, in.mean[i] = mean, in.square[i] = square;
}

}  // namespace

template <>
void catch_up<float>(const Queue& queue, const AdamInput<float>& in, const MissedSteps<float>& missed) {
  static_assert(sizeof(AdamConstants) == 7 * sizeof(float), "AdamStep has seven numbers");
  const int64_t n = in.rows * in.columns;
  if (!n) return;
  catch_up_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream_of(queue)>>>(in, missed);
  check_launch("catch_up");
}

}  // namespace cuda
}  // namespace gs
