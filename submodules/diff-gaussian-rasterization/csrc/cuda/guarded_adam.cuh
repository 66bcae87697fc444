// Adam's step of one value, for kernels, under a guard that ends a training at what is not finite.
#pragma once
#include <cuda_runtime.h>

#include "../data.h"
#include "../math/adam.h"

namespace gs {
namespace cuda {

// Whether there is a step in this iteration; a loss that is not finite is noted.
__device__ inline bool begin_step(const StepGuard<float>& guard) {
  if (baseline::may_step(guard)) return true;
  if (blockIdx.x == 0 && threadIdx.x == 0 && *guard.stopped == 0) *guard.stopped = guard.iteration;
  return false;
}

__device__ inline void step_value(const StepGuard<float>& guard, const baseline::AdamStep<float>& step,
                                  const AdamInput<float>& in, int64_t i) {
  float value = in.value[i], mean = in.mean[i], square = in.square[i];
  if (!guard.stopped)
    baseline::adam(step, in.gradient[i], value, mean, square);
  else if (!baseline::adam_if_finite(step, in.gradient[i], value, mean, square))
    *guard.stopped = guard.iteration;  // whoever writes it, it is the same
  in.value[i] = value, in.mean[i] = mean, in.square[i] = square;
}

}  // namespace cuda
}  // namespace gs
