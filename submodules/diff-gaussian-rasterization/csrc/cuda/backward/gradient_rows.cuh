#pragma once
// Gradient rows of the processed instances, side by side for each splat. A bit per slot tells which instances were
// processed, and a prefix sum over the bits tells where a row is. So memory is for these rows only, nothing is zeroed
// and nothing is added concurrently.
#include <cstdint>

#include "cuda/queue/queue.cuh"
#include "data.h"
#include "math/absolute.h"
#include "math/splat.h"

namespace gs {
namespace cuda {

struct RowPlaces {
  const uint32_t* bits;
  const int32_t* before;  // bits set before each word

  // The row of a slot; for a slot without one, the next row.
  __device__ int64_t row(int64_t slot) const {
    const uint32_t lower = (1u << (slot & 31)) - 1;
    return before[slot >> 5] + ((slot & 31) ? __popc(bits[slot >> 5] & lower) : 0);
  }
};

template <int kValues>
struct RowsOf : RowPlaces {
  float* values;  // (processed, kValues)
};

template <int kRays>
using GradientRows = RowsOf<baseline::kGradientRow<kRays>>;
using AbsoluteRows = RowsOf<baseline::kAbsoluteValues>;  // of the same instances

// The rows of a backward; those of absolute gradients have no memory unless they are wanted.
template <int kRays>
struct FilledRows {
  GradientRows<kRays> gradients;
  AbsoluteRows absolute;
};

// Runs the backward of blending up to the rows, and to BlendGradient::absolute if it is wanted. Waits for the number of
// rows if there may be many and the host does not run ahead.
template <int kRays>
GradientRows<kRays> fill_rows(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g);

// Sums the rows of a warp's splats, each in an order that depends on their number alone. The rows of neighbours lie
// side by side, so they come through shared memory in whole lines. A splat near the camera has thousands of rows, which
// the whole warp adds.
template <int kValues>
struct WarpSums {
  static constexpr int kOwnRows = 48;
  static constexpr int kStaged = kValues > 12 ? 64 : 96;  // rows at a time, whose loads a lane has in registers
  static constexpr int kStage = kStaged * kValues;        // floats of shared memory for each warp

  // All lanes of a warp call this, each with its own rows, from `begin` to `end`; there may be none.
  __device__ static void add_up(const float* rows, unsigned begin, unsigned end, float* sums, float* stage) {
    const int lane = threadIdx.x & 31;
    const bool many = end - begin > kOwnRows;
    for (int v = 0; v < kValues; ++v) sums[v] = 0;

    const unsigned last = warp_max(end);
    for (unsigned next = begin;;) {
      const bool open = !many && next < end;
      const unsigned first = warp_min(open ? next : ~0u);
      if (first == ~0u) break;
      const float2* from = reinterpret_cast<const float2*>(rows + int64_t(kValues) * first);
      const int pairs = kValues / 2 * int(last - first < kStaged ? last - first : kStaged);
      float2 loaded[kStage / 64];  // all are under way at once
#pragma unroll
      for (int k = 0; k < kStage / 64; ++k)
        if (lane + 32 * k < pairs) loaded[k] = from[lane + 32 * k];
      __syncwarp();  // every lane has added the rows before
#pragma unroll
      for (int k = 0; k < kStage / 64; ++k)
        if (lane + 32 * k < pairs) reinterpret_cast<float2*>(stage)[lane + 32 * k] = loaded[k];
      __syncwarp();
      if (open)
        for (; next < end && next - first < kStaged; ++next) add(stage + kValues * (next - first), sums);
    }

    for (unsigned left = __ballot_sync(kWarp, many); left; left &= left - 1) {
      const int owner = __ffs(left) - 1;
      const unsigned stop = __shfl_sync(kWarp, end, owner);
      float part[kValues] = {};
      for (unsigned row = __shfl_sync(kWarp, begin, owner) + lane; row < stop; row += 32)
        add(rows + int64_t(kValues) * row, part);
      for (int v = 0; v < kValues; ++v) {
        for (int step = 16; step; step /= 2) part[v] += __shfl_xor_sync(kWarp, part[v], step);
        if (lane == owner) sums[v] = part[v];
      }
    }
  }

 private:
  __device__ static void add(const float* row, float* sums) {
    for (int v = 0; v < kValues / 2; ++v) {
      const float2 pair = reinterpret_cast<const float2*>(row)[v];
      sums[2 * v] += pair.x, sums[2 * v + 1] += pair.y;
    }
  }
};

// Sums the rows of splats by their slots.
template <int kValues>
struct SlotSumsOf {
  static constexpr int kStage = WarpSums<kValues>::kStage;
  RowsOf<kValues> rows;
  const SplatSlots* slots;

  __device__ bool seen(int64_t splat) const { return slots[splat + 1].first > slots[splat].first; }

  // All lanes of a warp call this. Those whose splat is wanted get its sums, the others zeros.
  __device__ void read(int64_t splat, bool wanted, float* sums, float* stage) const {
    unsigned begin = 0, end = 0;  // instances are fewer than 2^31
    if (wanted) begin = unsigned(rows.row(slots[splat].first)), end = unsigned(rows.row(slots[splat + 1].first));
    WarpSums<kValues>::add_up(rows.values, begin, end, sums, stage);
  }
};

template <int kRays>
using SlotSums = SlotSumsOf<baseline::kGradientRow<kRays>>;

// Another source of moments: those that were summed before.
template <int kRays>
struct StoredMoments {
  const float* moments;
  const int32_t* tile_counts;
  __device__ bool seen(int64_t i) const { return tile_counts[i] != 0; }
  __device__ void read(int64_t i, bool wanted, float* m, float* /*stage*/) const {
    constexpr int kRow = baseline::kGradientRow<kRays>;
    for (int v = 0; wanted && v < kRow; ++v) m[v] = moments[kRow * i + v];
  }
};

// Finds the lengths of absolute gradients (N), 0 where a splat was not seen.
void find_lengths(const Queue& queue, int64_t count, const SlotSumsOf<baseline::kAbsoluteValues>& sums,
                  const float* splats, int rays, Image image, float* absolute);

// The gradients of the camera's numbers (math/camera_gradient.h).
void camera_vjp(const Queue& queue, const Scene<float>& s, const SlotSums<false>& source, double* out);

// Counts each splat's rows.
void count_rows(const Queue& queue, int64_t count, const RowPlaces& rows, const SplatSlots* slots, int32_t* counts);

// Writes rows of both kinds as rows of all their values.
template <int kRays>
void join_rows(const Queue& queue, int64_t rows, const FilledRows<kRays>& from, float* to);

// Makes rows by splat a source of sums, and finds RowSums::absolute if it is wanted.
template <int kRays>
SlotSums<kRays> sums_of(const Queue& queue, const SplatRows<float>& in, const RowSums<float>& to);

}  // namespace cuda
}  // namespace gs
