// Adds up runs of gradient rows before they go to other processes, and orders those that come.
#include <cuda_runtime.h>

#include <cub/cub.cuh>

#include "backend.h"
#include "cuda/backward/gradient_rows.cuh"

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

// Brings what is kept into the new order of runs.
__global__ void __launch_bounds__(kThreads) place_kernel(SumInput<float> in, int32_t* placed) {
  const int64_t run = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (run < in.runs && uint64_t(in.places[run]) < uint64_t(in.runs)) placed[in.places[run]] = in.kept[run];
}

// A thread takes a run. Most new rows of a warp lie side by side, so it writes them in whole lines, unless they are
// many.
template <int kValues>
__global__ void __launch_bounds__(kThreads)
    sum_runs_kernel(SumInput<float> in, const int32_t* begins, const int32_t* new_begins) {
  using Sums = WarpSums<kValues>;
  static_assert(Sums::kStage >= kRows * kValues, "a warp's new rows find room");
  constexpr int kPairs = kValues / 2;
  __shared__ __align__(16) float stages[kThreads / 32 * Sums::kStage];
  __shared__ unsigned targets[kThreads / 32][kRows];  // where each row of a stage goes
  const int lane = threadIdx.x & 31;
  unsigned* target = targets[threadIdx.x / 32];
  float* stage = stages + threadIdx.x / 32 * Sums::kStage;
  const int64_t run = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const bool mine = run < in.runs;
  const int64_t count = mine ? in.counts[run] : 0, from = mine ? begins[run] : 0, left = mine ? in.kept[run] : 0;
  const int64_t number = mine && in.places ? in.places[run] : run;
  const bool placed = uint64_t(number) < uint64_t(in.runs);
  const int64_t to = placed ? new_begins[number] : 0;
  const bool fits = placed && count >= 0 && from >= 0 && from + count <= in.rows && to >= 0 && to + left <= in.room;
  const int kept = fits && left >= 0 && (left <= 1 || left <= count) ? int(left) : 0;
  const unsigned begin = unsigned(from), new_begin = unsigned(to);
  alignas(8) float sums[kValues];
  Sums::add_up(in.from, kept == 1 ? begin : 0, kept == 1 ? begin + unsigned(count) : 0, sums, stage);

  const int counted = min(kept, kRows + 1);
  int place = counted;  // of the lane's rows in the stage
  for (int step = 1; step < 32; step *= 2) {
    const int before = __shfl_up_sync(kWarp, place, step);
    if (lane >= step) place += before;
  }
  const int total = __shfl_sync(kWarp, place, 31);
  if (!total) return;
  place -= counted;
  const bool staged = total <= kRows;
  float* to_rows = staged ? stage : in.to;
  const unsigned to_row = staged ? place : new_begin;
  __syncwarp();  // every lane has added what lies there
  if (kept == 1) copy_pairs(sums, kPairs, to_rows + int64_t(kValues) * to_row);
  if (staged)
    for (int k = 0; k < kept; ++k) target[place + k] = new_begin + k;
  // A splat over the whole image has thousands of rows, so the whole warp copies each run.
  for (unsigned many = __ballot_sync(kWarp, kept > 1); many; many &= many - 1) {
    const int owner = __ffs(many) - 1;
    const int rows = __shfl_sync(kWarp, kept, owner);
    const unsigned source = __shfl_sync(kWarp, begin, owner), first = __shfl_sync(kWarp, to_row, owner);
    copy_pairs(in.from + int64_t(kValues) * source, int64_t(kPairs) * rows, to_rows + int64_t(kValues) * first, lane,
               32);
  }
  if (!staged) return;
  __syncwarp();
  for (int k = lane; k < kPairs * total; k += 32)
    copy_pairs(stage + 2 * k, 1, in.to + int64_t(kValues) * target[k / kPairs] + 2 * (k % kPairs));
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
  const int32_t* kept = in.kept;
  if (in.places) {
    int32_t* placed = queue.array<int32_t>(in.runs);
    place_kernel<<<blocks_for(in.runs, kThreads), kThreads, 0, stream>>>(in, placed);
    check_launch("place_runs");
    kept = placed;
  }
  scan(in.counts, begins), scan(kept, new_begins);
  const auto sum = in.values == kGradientValues ? sum_runs_kernel<kGradientValues>
                                                : sum_runs_kernel<kGradientValues + kAbsoluteValues>;
  sum<<<blocks_for(in.runs, kThreads), kThreads, 0, stream>>>(in, begins, new_begins);
  check_launch("sum_runs");
}

}  // namespace cuda
}  // namespace gs
