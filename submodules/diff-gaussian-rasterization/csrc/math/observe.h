#pragma once
// The statistics of density control.
#include <cmath>
#include <cstdint>

#include "../data.h"
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

// Adds a view to the statistics of Gaussian i, of which the view has row `at`.
GS_HD void observe(const ObserveInput& in, int64_t i, int64_t at) {
  Observed o{in.max_radii[i], in.gradient_sums[i], in.views[i]};
  if (in.lengths)
    observe(in.radii[at], in.lengths[at], o);
  else
    observe(in.radii[at], in.gradients[3 * at], in.gradients[3 * at + 1], o);
  in.max_radii[i] = o.max_radius, in.gradient_sums[i] = o.gradient_sum, in.views[i] = o.views;
}

}  // namespace gs
