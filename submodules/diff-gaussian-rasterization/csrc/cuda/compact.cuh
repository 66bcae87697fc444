#pragma once
// Gradient rows of the instances that the backward processed, side by side for each splat. A bit per slot tells which
// were processed, a prefix sum over the bits where the row is: memory follows what was blended, nothing is zeroed or
// added concurrently.
#include <cstdint>

#include "../math/splat.h"

namespace gs {
namespace cuda {

struct Compact {
  const uint32_t* bits;
  const int32_t* before;  // bits set before each word
  float* rows;            // (processed, kGradientValues)

  // The row of a slot, or where it would be.
  __device__ int64_t row(int64_t slot) const {
    const uint32_t lower = (1u << (slot & 31)) - 1;
    return before[slot >> 5] + ((slot & 31) ? __popc(bits[slot >> 5] & lower) : 0);
  }
};

// The sums of a splat over its slots, in their order.
struct SlotSums {
  Compact compact;
  const int64_t* slot_offsets;
  const int32_t* tile_counts;

  __device__ void read(int64_t splat, float* sums) const {
    constexpr int kValues = baseline::kGradientValues;
    for (int v = 0; v < kValues; ++v) sums[v] = 0;
    const int64_t slot = slot_offsets[splat], stop = compact.row(slot + tile_counts[splat]);
    for (int64_t row = compact.row(slot); row < stop; ++row) {
      const float2* from = reinterpret_cast<const float2*>(compact.rows + kValues * row);
      for (int v = 0; v < kValues / 2; ++v) {
        const float2 pair = from[v];
        sums[2 * v] += pair.x, sums[2 * v + 1] += pair.y;
      }
    }
  }
};

}  // namespace cuda
}  // namespace gs
