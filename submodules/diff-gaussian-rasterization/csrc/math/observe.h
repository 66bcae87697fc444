#pragma once
// The statistics of density control.
#include <cmath>
#include <cstdint>

#include "gs/rounded.h"

namespace gs {

// A Gaussian's statistics over the views between two densifications, for adaptive density control (Kerbl et al. 2023,
// section 5.2).
struct Observed {
  float max_radius;    // pixels
  float gradient_sum;  // sum of the lengths of its mean's gradients on the screen, per NDC unit
  float views;         // views that saw it
};

// Adds a view, for a Gaussian of the given radius (0: not seen) and screen gradient.
GS_HD void observe(int32_t radius, float gradient_x, float gradient_y, Observed& o) {
  if (radius <= 0) return;
  if (float(radius) > o.max_radius) o.max_radius = float(radius);
  o.gradient_sum += std::sqrt(rounded_product(gradient_x, gradient_x) + rounded_product(gradient_y, gradient_y));
  o.views += 1;
}

// The same from a length that stands for the gradient's.
GS_HD void observe(int32_t radius, float length, Observed& o) {
  if (radius <= 0) return;
  if (float(radius) > o.max_radius) o.max_radius = float(radius);
  o.gradient_sum += length;
  o.views += 1;
}

}  // namespace gs
