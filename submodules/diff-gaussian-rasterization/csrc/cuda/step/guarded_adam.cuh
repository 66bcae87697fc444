#pragma once
// Adam's step of one value in a kernel, under a guard that stops a training at the first value that is not finite.
#include <cuda_runtime.h>

#include "data.h"
#include "math/adam.h"

namespace gs {
namespace cuda {

using AdamConstants = baseline::AdamStep<float>;  // of a step

// Tells whether this iteration takes a step, and records a loss that is not finite.
__device__ inline bool begin_step(const StepGuard<float>& guard) {
  if (baseline::may_step(guard)) return true;
  if (blockIdx.x == 0 && threadIdx.x == 0 && *guard.stopped == 0) *guard.stopped = guard.iteration;
  return false;
}

// Steps a value that is in registers: baseline::adam_if_finite with a guard, baseline::adam without. Returns whether it
// took the step. One path for both is half the code, which is repeated often and should stay in the instruction cache.
__device__ inline bool step_value(bool guarded, const AdamConstants& step, float gradient, float& value, float& mean,
                                  float& square) {
  float v = value, m = mean, s = square;
  baseline::adam<baseline::OneLane<float>>(step, gradient, v, m, s);
  const bool taken = (baseline::is_finite(v) & baseline::is_finite(m) & baseline::is_finite(s)) || !guarded;
  value = taken ? v : value;
  mean = taken ? m : NAN;
  square = taken ? s : square;
  return taken;
}

// Steps value i of a tensor.
__device__ inline void step_value(const StepGuard<float>& guard, const AdamConstants& step, const AdamInput<float>& in,
                                  int64_t i) {
  float value = in.value[i], mean = in.mean[i], square = in.square[i];
  if (!step_value(guard.stopped != nullptr, step, in.gradient[i], value, mean, square))
    *guard.stopped = guard.iteration;  // every thread writes the same
  in.value[i] = value, in.mean[i] = mean, in.square[i] = square;
}

}  // namespace cuda
}  // namespace gs
