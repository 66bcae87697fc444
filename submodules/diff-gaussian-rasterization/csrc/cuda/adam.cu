#include <cuda_runtime.h>

#include "../launch.h"
#include "../math/adam.h"
#include "gs/cuda_check.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) adam_kernel(AdamInput<float> in, baseline::AdamStep<float> step) {
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k >= in.rows * in.columns) return;
  const int64_t i = in.columns == in.row ? k : k / in.columns * in.row + k % in.columns;
  float value = in.value[i], mean = in.mean[i], square = in.square[i];
  baseline::adam(step, in.gradient[i], value, mean, square);
  in.value[i] = value, in.mean[i] = mean, in.square[i] = square;
}

}  // namespace

template <>
void adam<float>(const Queue& queue, const AdamInput<float>& in) {
  const int64_t n = in.rows * in.columns;
  if (!n) return;
  const auto step = baseline::make_adam_step<float>(in.lr, in.beta1, in.beta2, in.eps, in.step);
  adam_kernel<<<unsigned((n + kThreads - 1) / kThreads), kThreads, 0, static_cast<cudaStream_t>(queue.stream)>>>(in,
                                                                                                                 step);
  check_launch("adam");
}

}  // namespace cuda
}  // namespace gs
