// Wakes blocks of Gaussians. A block of threads takes one after the other.
#include <cuda_runtime.h>

#include <algorithm>

#include "../backend.h"
#include "../math/scene_row.h"
#include "../math/sleep.h"
#include "guarded_adam.cuh"
#include "queue.cuh"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

constexpr int kThreads = kSleepBlock;
constexpr int64_t kMostBlocks = 2048;  // of threads; each makes the camera once

// The sums of a warp each, of every attribute's terms (MissedSum::sum).
struct PartialSums {
  float of_warp[kThreads / 32][kTermColumns];

  __device__ void add(const float* terms, int64_t taken, int64_t missed) {
    const int64_t j = threadIdx.x + 1;
    const bool counts = j <= missed;
    const float4* row = reinterpret_cast<const float4*>(terms + (taken + (counts ? j : 0)) % kTerms * kTermColumns);
    const float4 low = row[0], high = row[1];
    const float power = counts ? terms[j * kTermColumns + kPowers] : 0;
    float v[kStepped] = {low.x * power, low.y * power, low.z * power, low.w * power, high.x * power, high.y * power};
    for (int a = 0; a < kStepped; ++a) {
      for (int step = 16; step; step /= 2) v[a] += __shfl_xor_sync(kWarp, v[a], step);
      if ((threadIdx.x & 31) == 0) of_warp[threadIdx.x / 32][a] = v[a];
    }
  }
  __device__ float total(int attribute) const {
    float sum = 0;
    for (const auto& of : of_warp) sum += of[attribute];
    return sum;
  }
};

__device__ bool is_aligned(const float* p) { return reinterpret_cast<uintptr_t>(p) % 16 == 0; }

// Whole blocks go 16 bytes a thread, and several loads are under way before the first store.
__device__ void take_missed_of_whole_block(float* values, float* means, float* squares, int count,
                                           const MissedSum<float>& missed) {
  constexpr int kAhead = 3;
  float4 *value = reinterpret_cast<float4*>(values), *mean = reinterpret_cast<float4*>(means),
         *square = reinterpret_cast<float4*>(squares);
  for (int k = threadIdx.x; k < count; k += kThreads * kAhead) {
    float4 v[kAhead], m[kAhead], s[kAhead];
#pragma unroll
    for (int j = 0; j < kAhead; ++j)
      if (const int at = k + kThreads * j; at < count)
        v[j] = __ldcs(value + at), m[j] = __ldcs(mean + at), s[j] = __ldcs(square + at);
#pragma unroll
    for (int j = 0; j < kAhead; ++j) {
      const int at = k + kThreads * j;
      if (at >= count) continue;
      take_missed(missed, v[j].x, m[j].x, s[j].x), take_missed(missed, v[j].y, m[j].y, s[j].y);
      take_missed(missed, v[j].z, m[j].z, s[j].z), take_missed(missed, v[j].w, m[j].w, s[j].w);
      __stcs(value + at, v[j]);
      __stcs(mean + at, m[j]), __stcs(square + at, s[j]);
    }
  }
}

__device__ void take_missed_of_block(const AdamInput<float>& to, const MissedSum<float>& missed, int64_t first,
                                     int rows) {
  float *value = to.value + first * to.row, *mean = to.mean + first * to.row, *square = to.square + first * to.row;
  const int row = int(to.row), columns = int(to.columns);
  if (columns == row && rows == kThreads && is_aligned(value) && is_aligned(mean) && is_aligned(square))
    return take_missed_of_whole_block(value, mean, square, kThreads / 4 * row, missed);
  for (int k = threadIdx.x; k < rows * columns; k += kThreads) {
    const int at = k / columns * row + k % columns;
    float v = value[at], m = mean[at], s = square[at];
    take_missed(missed, v, m, s);
    value[at] = v, mean[at] = m, square[at] = s;
  }
}

// Notes what the step that follows would be for a row without a gradient.
__device__ void write_terms(const SleepInput<float>& in, int64_t number) {
  const int a = threadIdx.x;
  const AdamInput<float>& to = in.step.attributes[a];
  if (!to.columns) return;
  const float* c = in.step.now ? in.step.now->constants[a] : nullptr;
  const AdamConstants step = c ? AdamConstants{c[0], c[1], c[2], c[3], c[4], c[5], c[6]}
                               : make_adam_step<float>(to.lr, to.beta1, to.beta2, to.eps, to.step);
  in.terms[number % kTerms * kTermColumns + a] = step.rate / step.root_correction;
}

__global__ void __launch_bounds__(kThreads)
    wake_kernel(const int32_t* halted, Scene<float> s, const __grid_constant__ SleepInput<float> in) {
  if (is_halted(halted) || (in.step.guard.stopped && *in.step.guard.stopped)) return;
  const int64_t number = in.step.now ? in.step.now->step : int64_t(in.step.attributes[kStepMeans].step);
  __shared__ Camera<float> camera;
  __shared__ PartialSums sums;
  __shared__ MissedSum<float> steps[kStepped];
  if (blockIdx.x == 0 && threadIdx.x < kStepped) write_terms(in, number);
  if (threadIdx.x == 32) camera = camera_of(s);
  for (int64_t block = blockIdx.x; block * kThreads < s.count; block += gridDim.x) {
    const int64_t taken = in.taken[block], first = block * kThreads, i = first + threadIdx.x;
    const int64_t missed = number - 1 - taken;  // below 0 where this step is repeated
    bool seen = i < s.count;
    const Vec3<float> mean = seen ? load3(s.means + 3 * i) : Vec3<float>{};
    const Vec3<float> scales = seen ? load3(s.scales + 3 * i) : Vec3<float>{};
    __syncthreads();  // nobody reads the last block's sums any more
    if (missed > 0) sums.add(in.terms, taken, missed);
    __syncthreads();
    bool wakes = in.all || missed < 0;
    if (!wakes) {
      const float most = missed > 0 ? most_ratio(in.step.attributes[kStepMeans]) : 0;
      const Watch<float> watch(camera, missed > 0 ? most * sums.total(kStepMeans) : 0,
                               missed > 0 ? most * sums.total(kStepScales) : 0);
      const float largest = larger(larger(scales.x, scales.y), scales.z) + watch.log_scale;
      seen = seen && !surely_unseen(watch, mean, s.scale_modifier * exponential(largest));
      wakes = __syncthreads_or(seen);
    }
    if (wakes && missed > 0) {
      if (threadIdx.x < kStepped)
        steps[threadIdx.x] = missed_sum(in.step.attributes[threadIdx.x], sums.total(threadIdx.x), taken, missed);
      __syncthreads();
      const int rows = int(s.count - first < kThreads ? s.count - first : kThreads);
      for (int a = 0; a < kStepped; ++a)
        if (in.step.attributes[a].columns) take_missed_of_block(in.step.attributes[a], steps[a], first, rows);
    }
    if (threadIdx.x) continue;
    in.awake[block] = wakes;
    if (wakes) in.taken[block] = int32_t(number - in.all);
  }
}

}  // namespace

template <>
void wake<float>(const Queue& queue, const Scene<float>& s, const SleepInput<float>& in) {
  if (!s.count) return;
  const unsigned blocks = unsigned(std::min(sleep_blocks(s.count), kMostBlocks));
  wake_kernel<<<blocks, kThreads, 0, stream_of(queue)>>>(queue.halted, s, in);
  check_launch("wake");
}

}  // namespace cuda
}  // namespace gs
