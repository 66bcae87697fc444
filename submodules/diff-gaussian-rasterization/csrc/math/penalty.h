#pragma once
// Gradients of a penalty on a Gaussian's opacity and scales (Kheradmand et al. 2024, section 3.4), by raw parameters.
#include "exponential.h"

GS_ISA_BEGIN

// gradient + d (weight sigmoid(logit)) / d logit
template <class V>
GS_HD V with_opacity_penalty(V gradient, Scalar<V> weight, V logit) {
  const V e = exponential(-magnitude(logit)), d = 1 + e;
  return multiply_add(all<V>(weight), e / (d * d), gradient);
}

// gradient + d (weight e^log_scale) / d log_scale
template <class V>
GS_HD V with_scale_penalty(V gradient, Scalar<V> weight, V log_scale) {
  return multiply_add(all<V>(weight), exponential(log_scale), gradient);
}

GS_ISA_END
