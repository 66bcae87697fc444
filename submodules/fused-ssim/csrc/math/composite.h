#pragma once
// An image with alpha over a background.
#include <cstdint>

#include "gs/rounded.h"

namespace gs {

// One channel of an image, composited on a background in [0, 1] by its straight alpha (Porter and Duff 1984, "over").
GS_HD float composite(uint8_t color, uint8_t alpha, float background) {
  const float weight = float(alpha) / 255.0f;
  return rounded_product(float(color) / 255.0f, weight) + rounded_product(background, 1.0f - weight);
}

}  // namespace gs
