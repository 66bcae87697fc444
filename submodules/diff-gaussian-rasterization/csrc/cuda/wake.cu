// Wakes blocks of Gaussians. A block of threads takes a block.
#include <cuda_runtime.h>

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

__device__ void take_missed_of_block(const AdamInput<float>& to, const MissedSum<float>& missed, int64_t first,
                                     int64_t rows, bool keep) {
  for (int64_t k = threadIdx.x; k < rows * to.columns; k += kThreads) {
    const int64_t at = (first + k / to.columns) * to.row + k % to.columns;
    float value = to.value[at], mean = to.mean[at], square = to.square[at];
    take_missed(missed, value, mean, square);
    to.value[at] = value;
    if (keep) to.mean[at] = mean, to.square[at] = square;
  }
}

__global__ void __launch_bounds__(kThreads)
    wake_kernel(const int32_t* halted, Scene<float> s, const __grid_constant__ SleepInput<float> in) {
  if (is_halted(halted) || (in.waking == kWakeSeen && in.step.guard.stopped && *in.step.guard.stopped)) return;
  const StepNow* now = in.step.now;
  const int64_t number = now ? now->step : int64_t(in.step.attributes[kStepMeans].step), taken = in.taken[blockIdx.x];
  const int64_t missed = number - 1 - taken;  // below 0 where this step is repeated
  __shared__ MissedSum<float> sums[kStepped];
  __shared__ Camera<float> camera;
  if (threadIdx.x < kStepped) {
    const AdamInput<float>& to = in.step.attributes[threadIdx.x];
    if (to.columns && missed > 0) sums[threadIdx.x] = missed_sum(in.terms, threadIdx.x, to, taken, missed);
    if (to.columns && blockIdx.x == 0 && in.waking != kWakeToLook) {
      const float* c = now ? now->constants[threadIdx.x] : nullptr;
      const AdamConstants step = c ? AdamConstants{c[0], c[1], c[2], c[3], c[4], c[5], c[6]}
                                   : make_adam_step<float>(to.lr, to.beta1, to.beta2, to.eps, to.step);
      in.terms[number % kTerms * kStepped + threadIdx.x] = step.rate / step.root_correction;
    }
  }
  if (threadIdx.x == 32) camera = camera_of(s);
  __syncthreads();
  const int64_t first = int64_t(blockIdx.x) * kThreads, i = first + threadIdx.x;
  bool wakes = in.waking != kWakeSeen || missed < 0;
  if (!wakes) {
    const Watch<float> watch(camera, missed > 0 ? sums[kStepMeans].reach() : 0,
                             missed > 0 ? sums[kStepScales].reach() : 0);
    bool seen = i < s.count;
    if (seen) {
      const Vec3<float> scales = load3(s.scales + 3 * i);
      const float largest = larger(larger(scales.x, scales.y), scales.z) + watch.log_scale;
      seen = !surely_unseen(watch, load3(s.means + 3 * i), s.scale_modifier * exponential(largest));
    }
    wakes = __syncthreads_or(seen);
  }
  if (wakes && missed > 0) {
    const int64_t rows = s.count - first < kThreads ? s.count - first : kThreads;
    for (int a = 0; a < kStepped; ++a)
      take_missed_of_block(in.step.attributes[a], sums[a], first, rows, in.waking != kWakeToLook);
  }
  if (threadIdx.x || in.waking == kWakeToLook) return;
  in.awake[blockIdx.x] = wakes;
  if (wakes) in.taken[blockIdx.x] = int32_t(number - (in.waking == kWakeAll));
}

}  // namespace

template <>
void wake<float>(const Queue& queue, const Scene<float>& s, const SleepInput<float>& in) {
  if (!s.count) return;
  wake_kernel<<<blocks_for(s.count, kThreads), kThreads, 0, stream_of(queue)>>>(queue.halted, s, in);
  check_launch("wake");
}

}  // namespace cuda
}  // namespace gs
