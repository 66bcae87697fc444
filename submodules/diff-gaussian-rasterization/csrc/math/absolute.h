#pragma once
// Absolute gradients of a mean on the image (Ye et al. 2024, AbsGS): what its pixels want is added up without signs, so
// that pixels on two sides of a large Gaussian do not cancel out.
#include "../data.h"
#include "constants.h"
#include "vec.h"

GS_ISA_BEGIN

// Sums over pixels for a splat, as the moments of footprint.h: of |q u| and of |q (l12 u + l22 v)|.
constexpr int kAbsoluteValues = 2;

// sqrt((sum |dL_p/dx|)^2 + (sum |dL_p/dy|)^2) per NDC unit, dL_p what pixel p alone makes of the loss; see mean_vjp.
template <class T>
GS_HD T absolute_length(T l11, T u, T uv, Image image) {
  return length(T(kLn2) * T(image.width) * (l11 * u), T(kLn2) * T(image.height) * uv);
}

GS_ISA_END
