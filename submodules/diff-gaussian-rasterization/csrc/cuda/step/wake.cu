// Wakes blocks of Gaussians. A block of threads takes one of them.
#include <cuda_runtime.h>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <algorithm>
#include <cub/cub.cuh>

#include "backend.h"
#include "cuda/queue/ahead.cuh"
#include "cuda/queue/queue.cuh"
#include "guarded_adam.cuh"
#include "math/scene_row.h"
#include "math/sleep.h"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

constexpr int kThreads = kSleepBlock;
static_assert(kThreads == kTerms, "a thread makes the decays of a number of missed steps");

// What all blocks share.
struct Waking {
  LensCamera<float> camera;  // or, of a pinhole, its base
  MissedSums<float> missed;
  int64_t number;  // of the step
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

__device__ bool has_stopped(const SleepInput<float>& in) { return in.step.guard.stopped && *in.step.guard.stopped; }

// Notes what the step that follows would be for a row without a gradient.
__device__ void write_terms(const SleepInput<float>& in, int attribute, int64_t number) {
  const AdamInput<float>& to = in.step.attributes[attribute];
  const float* c = in.step.now ? in.step.now->constants[attribute] : nullptr;
  const AdamConstants step = c ? AdamConstants{c[0], c[1], c[2], c[3], c[4], c[5], c[6]}
                               : make_adam_step<float>(to.lr, to.beta1, to.beta2, to.eps, to.step);
  in.terms[number % kTerms * kTermColumns + attribute] = step.rate / step.root_correction;
}

__global__ void __launch_bounds__(kThreads)
    prepare_kernel(const int32_t* halted, Scene<float> s, const __grid_constant__ SleepInput<float> in, Waking* out) {
  if (!begin_work(halted)) return;
  __shared__ float terms[kTerms * kTermColumns];  // each is read once, one after the other
  for (int k = threadIdx.x; k < kTerms * kTermColumns; k += kThreads) terms[k] = in.terms[k];
  __syncthreads();
  const int a = threadIdx.x;
  const int64_t number = in.step.now ? in.step.now->step : int64_t(in.step.attributes[kStepMeans].step);
  out->missed.set_decays(in.step.attributes[kStepMeans], number, threadIdx.x);
  if (a < kStepped && in.step.attributes[a].columns) {
    if (!has_stopped(in)) write_terms(in, a, number);
    out->missed.add_up(in.step.attributes[a], terms, a, number);
  }
  if (threadIdx.x == 64) out->number = number;
  if (threadIdx.x != 96) return;
  if (s.lens.chart == Chart::kPinhole)
    set_camera(s, static_cast<Camera<float>&>(out->camera));
  else
    set_camera(s, out->camera);
}

// Tests which blocks a view may show.
template <class AnyCamera>
__global__ void __launch_bounds__(kThreads)
    test_kernel(const int32_t* halted, Scene<float> s, const __grid_constant__ SleepInput<float> in,
                const Waking* waking, uint8_t* seen) {
  if (!begin_work(halted)) return;
  const int64_t block = blockIdx.x, i = block * kThreads + threadIdx.x;
  // Read at once, before it is known whether they are needed.
  bool mine = i < s.count;
  const Vec3<float> mean = mine ? load3(s.means + 3 * i) : Vec3<float>{};
  const Vec3<float> scales = mine ? load3(s.scales + 3 * i) : Vec3<float>{};
  const int64_t missed = missed_before(waking->number, in.taken[block]);
  if (mine && missed >= 0) {
    const MissedSums<float>& sums = waking->missed;
    const Watch<AnyCamera> watch(waking->camera, missed ? sums.reach(kStepMeans, missed) : 0,
                                 missed ? sums.reach(kStepScales, missed) : 0);
    const float largest = larger(larger(scales.x, scales.y), scales.z) + watch.log_scale;
    mine = !surely_unseen(watch, mean, s.scale_modifier * exponential(largest));
  }
  const bool wakes = __syncthreads_or(mine);
  if (threadIdx.x == 0) seen[block] = wakes;
}

// Lets blocks take the steps that they have missed: a block of threads each of those that are listed, or of all. The
// blocks between them sleep.
__global__ void __launch_bounds__(kThreads)
    take_missed_kernel(const int32_t* halted, int64_t count, const __grid_constant__ SleepInput<float> in,
                       const Waking* waking) {
  if (!begin_work(halted) || has_stopped(in)) return;
  const int64_t place = blockIdx.x, blocks = sleep_blocks(count), block = in.all ? place : in.blocks[place];
  if (!in.all) {
    const int64_t before = place ? in.blocks[place - 1] : -1;
    if (place && before < 0) return;
    const auto sleep = [&](int64_t first, int64_t end) {
      for (int64_t b = first + threadIdx.x; b < end; b += kThreads) in.awake[b] = 0;
    };
    sleep(before + 1, block < 0 ? blocks : block);
    if (block < 0) return;
    if (place == in.room - 1) sleep(block + 1, blocks);
  }
  const int64_t missed = missed_before(waking->number, in.taken[block]), first = block * kThreads;
  const int rows = int(count - first < kThreads ? count - first : kThreads);
  for (int a = 0; a < kStepped && missed > 0; ++a)
    if (in.step.attributes[a].columns)
      take_missed_of_block(in.step.attributes[a], waking->missed.of(a, missed), first, rows);
  __syncthreads();  // all have read `taken`
  if (threadIdx.x == 0) in.awake[block] = 1, in.taken[block] = int32_t(waking->number - in.rests);
}

struct IsAwake {
  const uint8_t* awake;
  int64_t blocks;
  __host__ __device__ int32_t operator()(int64_t block) const {
#ifdef __CUDA_ARCH__
    if (block < blocks) return awake[block] != 0;
#endif
    return 0;
  }
};

// Takes the number of blocks before one that are awake. Behind the last one stands the number of all.
struct ListedAt {
  IsAwake is_awake;
  Ahead ahead;
  int32_t* list;
  int64_t room, block;
  __host__ __device__ void operator=(int32_t before) const {
#ifdef __CUDA_ARCH__
    if (block == is_awake.blocks && ahead.halted) judge_blocks(ahead, before);
    if (is_awake(block) && before < room) list[before] = int32_t(block);
#endif
  }
};

struct Listed {
  ListedAt at;
  __host__ __device__ ListedAt operator()(int64_t block) const {
    return {at.is_awake, at.ahead, at.list, at.room, block};
  }
};

// Lists the blocks that have a flag, as far as there is room.
void list_seen(const Queue& queue, const uint8_t* seen, int64_t blocks, const SleepInput<float>& in) {
  GS_CUDA_CHECK(cudaMemsetAsync(in.blocks, -1, in.room * sizeof *in.blocks, stream_of(queue)));
  const IsAwake is_awake{seen, blocks};
  const thrust::counting_iterator<int64_t> every(0);
  const auto flags = thrust::make_transform_iterator(every, is_awake);
  const auto places =
      thrust::make_transform_iterator(every, Listed{{is_awake, in.ahead ? *in.ahead : Ahead{}, in.blocks, in.room, 0}});
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, flags, places, blocks + 1, stream_of(queue));
  });
}

}  // namespace

template <>
void wake<float>(const Queue& queue, const Scene<float>& s, const SleepInput<float>& in) {
  if (!s.count) return;
  const int64_t blocks = sleep_blocks(s.count);
  Waking* waking = queue.array<Waking>(1);
  launch(queue, "prepare", prepare_kernel, 1, kThreads, s, in, waking);
  if (!in.all) {
    uint8_t* seen = queue.array<uint8_t>(blocks);
    const auto test = s.lens.chart == Chart::kPinhole ? test_kernel<Camera<float>> : test_kernel<LensCamera<float>>;
    launch(queue, "test", test, unsigned(blocks), kThreads, s, in, waking, seen);
    list_seen(queue, seen, blocks, in);
  }
  launch(queue, "take_missed", take_missed_kernel, unsigned(in.all ? blocks : in.room), kThreads, s.count, in, waking);
}

}  // namespace cuda
}  // namespace gs
