#pragma once
// Moves rows of sh_rest and of its gradient through shared memory, because a thread's own 180 bytes are not coalesced.
// A warp moves the rows of its own 32 Gaussians.
#include "cuda/queue/queue.cuh"
#include "math/sh.h"

namespace gs {
namespace cuda {

using namespace baseline;  // the math headers' namespace in a build without instruction sets

constexpr int kRest = 3 * (sh_count(kMaxShDegree) - 1);  // 45 values: odd, so that rows start in different banks

// From this many wanted rows on, copying all 32 is cheaper: that costs 12 copies a lane, a single row costs 2.
constexpr int kManyRows = 20;

// Starts asynchronous copies of the wanted rows into shared memory, and skips rows already in flight. `wanted` and
// `flowing` have a bit for each lane; each row gives `values` floats, and the tensor has `count` rows. Returns the rows
// now in flight, which may be more than wanted.
__device__ inline unsigned fetch_rows(const float* global, int64_t first, int64_t count, int64_t stride, int values,
                                      unsigned wanted, unsigned flowing, float* rows) {
  wanted &= ~flowing;
  if (!wanted) return flowing;
  const int lane = threadIdx.x & 31;
  const float* from = global + first * stride;
  if (!flowing && __popc(wanted) >= kManyRows && first + 32 <= count && stride == kRest && values == kRest &&
      reinterpret_cast<uintptr_t>(from) % 16 == 0) {
#pragma unroll
    for (int k = 0; k < (kRest * 32 + 127) / 128; ++k) {
      const int at = 4 * (32 * k + lane);
      if (at < kRest * 32) start_copy(reinterpret_cast<float4*>(rows + at), reinterpret_cast<const float4*>(from + at));
    }
    wanted = kWarp;
  } else {
    for (unsigned left = wanted; left; left &= left - 1) {
      const int row = __ffs(left) - 1;
      for (int v = lane; v < values; v += 32) start_copy(rows + row * kRest + v, from + row * stride + v);
    }
  }
  __pipeline_commit();
  return flowing | wanted;
}

__device__ inline void wait_for_rows() {
  __pipeline_wait_prior(0);
  __syncwarp();
}

// Writes the warp's first `count` rows to a tensor whose rows have `values` floats, one after the other.
__device__ inline void write_rows(const float* rows, int64_t first, int count, int values, float* global) {
  __syncwarp();
  const int lane = threadIdx.x & 31;
  float* to = global + first * values;
  if (values == kRest && count == 32 && reinterpret_cast<uintptr_t>(to) % 16 == 0) {
#pragma unroll
    for (int k = 0; k < (kRest * 32 + 127) / 128; ++k) {
      const int at = 32 * k + lane;
      if (4 * at < kRest * 32) reinterpret_cast<float4*>(to)[at] = reinterpret_cast<const float4*>(rows)[at];
    }
  } else {
    for (int row = 0; row < count; ++row)
      for (int v = lane; v < values; v += 32) to[row * values + v] = rows[row * kRest + v];
  }
}

}  // namespace cuda
}  // namespace gs
