// Adds up runs of gradient rows before they go to other processes.
#include <cuda_runtime.h>

#include <cub/cub.cuh>

#include "../backend.h"
#include "gradient_rows.cuh"

namespace gs {
namespace cuda {

using baseline::kAbsoluteValues, baseline::kGradientValues;

namespace {

constexpr int kThreads = 128, kRows = 32;  // new rows of a warp that go through shared memory

// One of `lanes` threads that copy side by side.
__device__ inline void copy_pairs(const float* from, int64_t pairs, float* to, int lane = 0, int lanes = 1) {
  for (int64_t k = lane; k < pairs; k += lanes)
    reinterpret_cast<float2*>(to)[k] = reinterpret_cast<const float2*>(from)[k];
}

// A thread takes a run. The new rows of a warp lie side by side, so it writes them in whole lines, unless they are
// many.
template <int kValues>
__global__ void __launch_bounds__(kThreads)
    sum_runs_kernel(SumInput<float> in, const int32_t* begins, const int32_t* new_begins) {
  using Sums = WarpSums<kValues>;
  static_assert(Sums::kStage >= kRows * kValues, "a warp's new rows find room");
  __shared__ __align__(16) float stages[kThreads / 32 * Sums::kStage];
  const int lane = threadIdx.x & 31;
  float* stage = stages + threadIdx.x / 32 * Sums::kStage;
  const int64_t run = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const bool mine = run < in.runs;
  const int64_t count = mine ? in.counts[run] : 0, from = mine ? begins[run] : 0;
  int64_t kept = mine ? in.kept[run] : 0;
  const int64_t to = mine ? new_begins[run] : 0;
  const bool fits = count >= 0 && from >= 0 && from + count <= in.rows && to >= 0 && to + kept <= in.room;
  if (!fits || kept < 0 || (kept > 1 && kept > count)) kept = 0;
  alignas(8) float sums[kValues];
  Sums::add_up(in.from, kept == 1 ? unsigned(from) : 0, kept == 1 ? unsigned(from + count) : 0, sums, stage);

  const unsigned first = warp_min(kept ? unsigned(to) : ~0u);
  const unsigned end = warp_max(unsigned(kept ? to + kept : 0));
  if (first >= end) return;
  const bool staged = end - first <= kRows;
  float* new_rows = in.to + int64_t(kValues) * first;
  float* written = staged ? stage : new_rows;
  __syncwarp();  // every lane has added what lies there
  if (kept == 1) copy_pairs(sums, kValues / 2, written + kValues * (to - first));
  // A splat over the whole image has thousands of rows, so the whole warp copies each run.
  for (unsigned left = __ballot_sync(kWarp, kept > 1); left; left &= left - 1) {
    const int owner = __ffs(left) - 1;
    const int rows = __shfl_sync(kWarp, int(kept), owner);
    const unsigned source = __shfl_sync(kWarp, unsigned(from), owner), place = __shfl_sync(kWarp, unsigned(to), owner);
    copy_pairs(in.from + int64_t(kValues) * source, int64_t(kValues / 2) * rows,
               written + int64_t(kValues) * (place - first), lane, 32);
  }
  if (!staged) return;
  __syncwarp();
  copy_pairs(stage, kValues / 2 * (end - first), new_rows, lane, 32);
}

}  // namespace

void sum_runs(const Queue& queue, const SumInput<float>& in) {
  if (!in.runs) return;
  const cudaStream_t stream = stream_of(queue);
  int32_t *begins = queue.array<int32_t>(in.runs), *new_begins = queue.array<int32_t>(in.runs);
  const auto scan = [&](const int32_t* counts, int32_t* sums) {
    with_memory(queue, [&](void* memory, size_t& bytes) {
      return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, sums, in.runs, stream);
    });
  };
  scan(in.counts, begins), scan(in.kept, new_begins);
  const auto sum = in.values == kGradientValues ? sum_runs_kernel<kGradientValues>
                                                : sum_runs_kernel<kGradientValues + kAbsoluteValues>;
  sum<<<blocks_for(in.runs, kThreads), kThreads, 0, stream>>>(in, begins, new_begins);
  check_launch("sum_runs");
}

}  // namespace cuda
}  // namespace gs
