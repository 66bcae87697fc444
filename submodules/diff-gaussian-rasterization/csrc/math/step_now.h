#pragma once
// What changes from step to step, for steps that are recorded once and taken often.
#include <cstdint>

#include "adam.h"

namespace gs {

struct StepNow {
  baseline::AdamStep<float> constants[kStepped];
  int64_t iteration;  // of the guard
};

// The operators carry it as a tensor of int64.
constexpr int64_t kStepNowWords = sizeof(StepNow) / sizeof(int64_t);
static_assert(sizeof(StepNow) % sizeof(int64_t) == 0, "whole words");

// sparse: without bias correction.
inline baseline::AdamStep<float> step_constants(bool sparse, double lr, double beta1, double beta2, double eps,
                                                double step) {
  if (sparse) return baseline::make_uncorrected_adam_step<float>(lr, beta1, beta2, eps);
  return baseline::make_adam_step<float>(lr, beta1, beta2, eps, step);
}

}  // namespace gs
