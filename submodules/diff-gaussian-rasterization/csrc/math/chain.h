#pragma once
// The chain rule of a step whose opacities and scales in the Scene are functions of the parameters that it changes, as
// the 3D smoothing filter's are (splatting/parts/filter_3d.py).
#include <cstdint>

#include "gs/rounded.h"

namespace gs {

// Factors of a Gaussian: d logit / d its parameter; for each scale d log scale / d its parameter; for each scale
// d logit / d its parameter.
constexpr int kChain = 7;

// Makes the gradients of a Gaussian's logit and log scales those of its parameters.
template <class T>
GS_HD void chain_rule(const T* factors, T* logit, T* log_scales) {
  for (int k = 0; k < 3; ++k)
    log_scales[k] = rounded_product(factors[1 + k], log_scales[k]) + rounded_product(factors[4 + k], *logit);
  *logit = rounded_product(factors[0], *logit);
}

}  // namespace gs
