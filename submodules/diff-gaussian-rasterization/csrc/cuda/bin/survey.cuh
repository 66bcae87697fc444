#pragma once
// Looks at the splats before they are binned: how long the lists will be, and how far apart on the image splats lie
// that have neighbouring rows.
#include "cuda/project/tile_record.cuh"
#include "cuda/queue/host_numbers.cuh"
#include "math/slots.h"

namespace gs {
namespace cuda {

constexpr int64_t kManyTiles = 1 << 14;  // which lists need several windows for (tile_lists.cuh)
// Rows from which on a survey is taken, of images of more tiles and of others. With fewer, neither way is much faster.
constexpr int64_t kLeastSurveyed = 1 << 18, kLeastOfFewTiles = 1 << 21;
constexpr int64_t kInstancesOfRow = 2;  // up to which sorting all rows by depth takes longer than it saves
constexpr int kFarTiles = 8;
constexpr double kScatteredShare = 0.25;

struct Survey {
  int64_t instances, slots;
  int64_t pairs;  // of neighbouring rows whose splats both reach tiles; one in 32 is not counted
  int64_t far;    // those whose rectangles begin more than kFarTiles apart, across or down
};

// Whether a survey may gain more than it costs.
inline bool survey_pays(int64_t rows, int64_t tiles) {
  return rows >= (tiles > kManyTiles ? kLeastSurveyed : kLeastOfFewTiles);
}

// Whether two sorts of everything take less time than lists of tiles.
inline bool sorting_pays(const Survey& seen, int64_t rows, int64_t tiles) {
  const bool scattered = double(seen.far) > kScatteredShare * double(seen.pairs);
  return seen.instances > kInstancesOfRow * rows && (scattered || tiles > kManyTiles);
}

constexpr int kSurveyThreads = 256;
constexpr int kSurveyed = 4;  // rows of a thread, whose loads do not wait for each other

// Adds up what Survey has, in its order.
static __global__ void __launch_bounds__(kSurveyThreads)
    survey_kernel(const int32_t* halted, int64_t n, Projected<float> in, unsigned long long* sums) {
  if (!begin_work(halted)) return;
  __shared__ unsigned long long of_block[4];
  if (threadIdx.x < 4) of_block[threadIdx.x] = 0;
  __syncthreads();
  const int64_t first = int64_t(blockIdx.x) * kSurveyed * kSurveyThreads + threadIdx.x;
  Reached reached[kSurveyed];
#pragma unroll
  for (int r = 0; r < kSurveyed; ++r) {
    const int64_t i = first + r * kSurveyThreads;
    reached[r] = i < n ? reached_by(in, int32_t(i)) : Reached{};
  }
  unsigned long long instances = 0, slots = 0;
  unsigned all_pairs = 0, all_far = 0;  // of the warp
#pragma unroll
  for (const Reached& own : reached) {
    instances += own.count, slots += baseline::slot_count(own.rect);
    const unsigned some = __ballot_sync(kWarp, own.count > 0), pairs = some & some >> 1;
    const int x = __shfl_down_sync(kWarp, own.rect.x0, 1), y = __shfl_down_sync(kWarp, own.rect.y0, 1);
    const bool far = abs(x - own.rect.x0) > kFarTiles || abs(y - own.rect.y0) > kFarTiles;
    all_pairs += __popc(pairs), all_far += __popc(pairs & __ballot_sync(kWarp, far));
  }
  for (int step = 16; step; step /= 2) {
    instances += __shfl_xor_sync(kWarp, instances, step);
    slots += __shfl_xor_sync(kWarp, slots, step);
  }
  if (threadIdx.x % 32 == 0) {
    const unsigned long long of_warp[] = {instances, slots, all_pairs, all_far};
    for (int k = 0; k < 4; ++k) atomicAdd(of_block + k, of_warp[k]);
  }
  __syncthreads();
  if (threadIdx.x < 4) atomicAdd(sums + threadIdx.x, of_block[threadIdx.x]);
}

// Surveys splats that have records. The host waits.
inline Survey survey(const Queue& queue, int64_t n, const Projected<float>& in) {
  auto* sums = queue.array<unsigned long long>(4);
  GS_CUDA_CHECK(cudaMemsetAsync(sums, 0, 4 * sizeof *sums, stream_of(queue)));
  launch(queue, "survey", survey_kernel, blocks_for(n, kSurveyed * kSurveyThreads), kSurveyThreads, n, in, sums);
  const HostNumbers<unsigned long long> numbers(queue, sums, 4);
  const unsigned long long* all = numbers.wait();
  return {int64_t(all[0]), int64_t(all[1]), int64_t(all[2]), int64_t(all[3])};
}

}  // namespace cuda
}  // namespace gs
