#pragma once
// Which Gaussians a block of kSleepBlock threads takes.
#include "data.h"

namespace gs {
namespace cuda {

// The block of Gaussians in place `place` of those that are awake; -1: none, or it sleeps.
__device__ inline int64_t awake_block(const Scene<float>& s, int64_t place) {
  if (s.blocks) return s.blocks[place];
  return s.awake && !s.awake[place] ? -1 : place;
}

// The Gaussian whose row in what was made of them is `row`.
__device__ inline int64_t gaussian_at(const int32_t* blocks, int64_t row) {
  return blocks ? blocks[row / kSleepBlock] * kSleepBlock + row % kSleepBlock : row;
}

}  // namespace cuda
}  // namespace gs
