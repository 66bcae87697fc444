#pragma once
// Rows that may wait (math/lazy_rows.h), in kernels whose warps each take the rows of 32 Gaussians.
#include <cuda_runtime.h>

#include "../math/lazy_rows.h"
#include "queue.cuh"

namespace gs {
namespace cuda {

// The place of bit number n of those that are set, from 0; anything if there are fewer.
__device__ inline int nth_bit(unsigned bits, int n) {
  int place = 0;
  for (int width = 16; width; width /= 2) {
    const int below = __popc(bits >> place & ((1u << width) - 1));
    if (n >= below) n -= below, place += width;
  }
  return place;
}

// Notes the rows of a warp that took the step, a bit each. waiting: whether this lane met only values that may wait.
// One that may not makes all of them take every step, which is as right, and rare.
__device__ inline void note_rows(const LazyRows<float>& rows, int32_t number, int64_t first, unsigned stepped,
                                 bool waiting) {
  const int32_t last = __all_sync(kWarp, waiting) ? number : kEveryStep;
  const int lane = threadIdx.x & 31;
  if (stepped >> lane & 1) rows.last[first + lane] = last;
}

}  // namespace cuda
}  // namespace gs
