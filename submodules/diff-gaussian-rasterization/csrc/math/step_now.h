#pragma once
// The numbers of a step (gs::StepNow), made on the host for every backend.
#include <cstring>

#include "adam.h"

namespace gs {

// The operators carry them as a tensor of int64.
constexpr int64_t kStepNowWords = sizeof(StepNow) / sizeof(int64_t);
static_assert(sizeof(StepNow) % sizeof(int64_t) == 0, "whole words");

// sparse: without bias correction.
inline baseline::AdamStep<float> step_constants(bool sparse, double lr, double beta1, double beta2, double eps,
                                                double step) {
  if (sparse) return baseline::make_uncorrected_adam_step<float>(lr, beta1, beta2, eps);
  return baseline::make_adam_step<float>(lr, beta1, beta2, eps, step);
}

inline void set_constants(StepNow& now, int64_t attribute, const baseline::AdamStep<float>& constants) {
  static_assert(sizeof now.constants[0] == sizeof constants, "AdamStep has seven numbers");
  std::memcpy(now.constants[attribute], &constants, sizeof constants);
}

}  // namespace gs
