#pragma once
// Gradient rows of the instances that the backward processed, side by side for each splat. A bit per slot tells which
// were processed, a prefix sum over the bits where the row is: memory follows what was blended, nothing is zeroed or
// added concurrently.
#include <cstdint>

#include "../launch.h"
#include "../math/splat.h"
#include "queue.cuh"

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

// The sums of a splat over its slots, in an order that depends on their number alone. The rows of a warp's splats lie
// side by side, so they come by whole lines through shared memory. A splat near the camera has thousands: those are
// added by the whole warp.
struct SlotSums {
  static constexpr int kOwnRows = 48;
  static constexpr int kStaged = 32;                                  // rows at a time
  static constexpr int kStage = kStaged * baseline::kGradientValues;  // floats of shared memory for each warp
  Compact compact;
  const SplatSlots* slots;

  __device__ bool seen(int64_t splat) const { return slots[splat + 1].first > slots[splat].first; }

  // Called by all lanes of a warp; those that want a splat's sums get them, the others nothing.
  __device__ void read(int64_t splat, bool wanted, float* sums, float* stage) const {
    constexpr int kValues = baseline::kGradientValues;
    const int lane = threadIdx.x & 31;
    unsigned begin = 0, end = 0;  // instances are fewer than 2^31
    if (wanted) begin = unsigned(compact.row(slots[splat].first)), end = unsigned(compact.row(slots[splat + 1].first));
    const bool many = end - begin > kOwnRows;
    for (int v = 0; v < kValues; ++v) sums[v] = 0;

    const unsigned last = __reduce_max_sync(kWarp, end);
    for (unsigned next = begin;;) {
      const bool open = !many && next < end;
      const unsigned first = __reduce_min_sync(kWarp, open ? next : ~0u);
      if (first == ~0u) break;
      const float2* from = reinterpret_cast<const float2*>(compact.rows + int64_t(kValues) * first);
      const int pairs = kValues / 2 * int(last - first < kStaged ? last - first : kStaged);
      __syncwarp();  // the rows before have been added
      for (int k = lane; k < pairs; k += 32) reinterpret_cast<float2*>(stage)[k] = from[k];
      __syncwarp();
      if (open)
        for (; next < end && next - first < kStaged; ++next) add(stage + kValues * (next - first), sums);
    }

    for (unsigned left = __ballot_sync(kWarp, many); left; left &= left - 1) {
      const int owner = __ffs(left) - 1;
      const unsigned stop = __shfl_sync(kWarp, end, owner);
      float part[kValues] = {};
      for (unsigned row = __shfl_sync(kWarp, begin, owner) + lane; row < stop; row += 32)
        add(compact.rows + int64_t(kValues) * row, part);
      for (int v = 0; v < kValues; ++v) {
        for (int step = 16; step; step /= 2) part[v] += __shfl_xor_sync(kWarp, part[v], step);
        if (lane == owner) sums[v] = part[v];
      }
    }
  }

 private:
  __device__ static void add(const float* row, float* sums) {
    for (int v = 0; v < baseline::kGradientValues / 2; ++v) {
      const float2 pair = reinterpret_cast<const float2*>(row)[v];
      sums[2 * v] += pair.x, sums[2 * v + 1] += pair.y;
    }
  }
};

}  // namespace cuda
}  // namespace gs
