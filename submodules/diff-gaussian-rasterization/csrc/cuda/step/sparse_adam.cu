// Adam's step of the visible rows of a tensor.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/queue/queue.cuh"
#include "guarded_adam.cuh"
#include "math/step_now.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads)
    sparse_adam_kernel(const int32_t* halted, AdamInput<float> in, const bool* visible, AdamConstants step,
                       StepGuard<float> guard) {
  if (!begin_work(halted) || !begin_step(guard)) return;
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k >= in.rows * in.columns) return;
  const int64_t r = k / in.columns;
  if (!visible[r]) return;
  const int64_t i = r * in.row + k % in.columns;
  step_value(guard, step, in, i);
}

}  // namespace

template <>
void sparse_adam<float>(const Queue& queue, const AdamInput<float>& in, const bool* visible,
                        const StepGuard<float>& guard) {
  const int64_t n = in.rows * in.columns;
  if (!n) return;
  const AdamConstants step = step_constants(in.step == 0, in.lr, in.beta1, in.beta2, in.eps, in.step);
  launch(queue, "sparse_adam", sparse_adam_kernel, blocks_for(n, kThreads), kThreads, in, visible, step, guard);
}

}  // namespace cuda
}  // namespace gs
