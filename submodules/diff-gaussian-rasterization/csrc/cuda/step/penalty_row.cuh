#pragma once
// The penalties of a Gaussian, added to its gradients. No caller inlines them, so all round in the same way.
#include "data.h"
#include "math/penalty.h"

namespace gs {
namespace cuda {

__device__ __noinline__ inline void penalise_opacity(const Penalty<float>& penalty, const float* logit,
                                                     float* gradient) {
  *gradient = baseline::with_opacity_penalty(*gradient, penalty.opacity, *logit);
}

__device__ __noinline__ inline void penalise_scales(const Penalty<float>& penalty, const float* log_scales,
                                                    float* gradients) {
  for (int k = 0; k < 3; ++k) gradients[k] = baseline::with_scale_penalty(gradients[k], penalty.scale, log_scales[k]);
}

}  // namespace cuda
}  // namespace gs
