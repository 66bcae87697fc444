#pragma once
// What density control computes of every row by itself, with the same bits on every device.
#include "../data.h"
#include "random.h"

namespace gs {

GS_HD void elementary(const Elementary& in, int64_t i) {
  in.out[i] = in.logarithm ? portable::log(in.values[i]) : portable::exp(in.values[i]);
}

GS_HD void random_words(const RandomInput& in, int64_t i) {
  const RandomWords words = philox({{uint32_t(in.items[i]), in.draw, in.iteration, in.stream}}, in.seed);
  for (int k = 0; k < 4; ++k) in.out[4 * i + k] = words.w[k];
}

}  // namespace gs
