// Adds the gradients of penalties. A thread takes a Gaussian.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/queue/queue.cuh"
#include "penalty_row.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) penalty_kernel(const int32_t* halted, PenaltyInput<float> in) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.count) return;
  penalise_opacity(in.penalty, in.logits + i, in.logit_gradients + i);
  penalise_scales(in.penalty, in.log_scales + 3 * i, in.log_scale_gradients + 3 * i);
}

}  // namespace

template <>
void penalise<float>(const Queue& queue, const PenaltyInput<float>& in) {
  if (!in.count) return;
  launch(queue, "penalise", penalty_kernel, blocks_for(in.count, kThreads), kThreads, in);
}

}  // namespace cuda
}  // namespace gs
