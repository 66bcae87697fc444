#pragma once
// Longest-first schedule of tile lists, or of chunks of them: a long list started last would leave one multiprocessor
// working alone.
#include <algorithm>
#include <cstdint>

#include "cuda/queue/queue.cuh"

namespace gs {
namespace cuda {

constexpr int kOrderThreads = 1024;
constexpr int kLengthClasses = 256;            // eight to a doubling
constexpr int64_t kMostOrdered = 16384;        // tiles; sorting more would take a block too long
constexpr int32_t kWhole = int32_t(~0u >> 1);  // the size of chunks if lists are not cut

// A part of a tile's list, for one block. All chunks of a tile but the first have places, side by side.
struct alignas(16) Chunk {
  int32_t tile;        // -1 where there is none
  int32_t first, end;  // positions in the list
  int32_t behind;      // the place of the chunk behind this one, even if there is none
};

struct Schedule {
  const Chunk* chunks;
  unsigned blocks;  // one for each chunk; some may have none
  unsigned places;  // at most
  int32_t size;     // of a chunk

  // The schedule for lists whose lengths sum to at most `total`.
  Schedule shortened(int64_t total) const {
    const unsigned fewer = unsigned(std::min<int64_t>(places, total / size));
    return {chunks, blocks - places + fewer, fewer, size};
  }
};

// Longer lists have smaller classes.
__device__ inline int length_class(int64_t length) {
  const uint32_t bits = __float_as_uint(float(length) + 1);     // 1 to 2^32
  return kLengthClasses - 1 - int((bits - 0x3f800000u) >> 20);  // exponent and three bits of the mantissa
}

// The number of chunks of a list before its last one, which has the rest.
__device__ inline int32_t full_chunks(int32_t length, int32_t size) { return length ? (length - 1) / size : 0; }

struct CutList {
  int32_t length, size;  // size: of its chunks
};

// The plan that serves the longest chunks first. A plan cuts lists, and puts chunks into classes, which are served in
// ascending order.
template <class Length>
struct LongestFirst {
  static constexpr int kClasses = kLengthClasses;  // a multiple of 32
  Length length;
  int32_t size;

  __device__ CutList list(int tile) const { return {int32_t(length(tile)), size}; }

  // Calls run(class, first chunk, count) for consecutive chunks of a class.
  template <class Run>
  __device__ void runs(const CutList& list, const Run& run) const {
    const int32_t full = full_chunks(list.length, list.size);
    if (full) run(length_class(list.size), 0, full);
    run(length_class(list.length - full * list.size), full, 1);
  }
};

// Turns the lengths of classes into the positions where they begin. Returns the sum. Only the first warp calls this.
template <int kClasses>
__device__ inline int32_t begin_classes(int32_t (&next)[kClasses]) {
  static_assert(kClasses % 32 == 0);
  constexpr int kOwn = kClasses / 32;
  const int lane = threadIdx.x, own = kOwn * lane;
  int32_t end = 0;
  for (int c = 0; c < kOwn; ++c) end += next[own + c];
  const int32_t sum = end;
  for (int step = 1; step < 32; step *= 2) {
    const int32_t before = __shfl_up_sync(kWarp, end, step);
    if (lane >= step) end += before;
  }
  const int32_t total = __shfl_sync(kWarp, end, 31);
  int32_t begin = end - sum;
  for (int c = 0; c < kOwn; ++c) {
    const int32_t count = next[own + c];
    next[own + c] = begin;
    begin += count;
  }
  return total;
}

// Sorts chunks by class, in one block. The order within a class and the order of places are arbitrary, but that chunks
// of one run stay together; no result depends on them. Also sets `count` numbers at `zeros` to 0.
template <class Plan>
__global__ void __launch_bounds__(kOrderThreads)
    order_chunks_kernel(const int32_t* halted, int tiles, Plan plan, int blocks, Chunk* chunks, int32_t* zeros,
                        int64_t count) {
  if (!begin_work(halted)) return;
  __shared__ int32_t next[Plan::kClasses], total, places;
  for (int c = threadIdx.x; c < Plan::kClasses; c += kOrderThreads) next[c] = 0;
  if (threadIdx.x == 0) places = 0;
  __syncthreads();
  for (int t = threadIdx.x; t < tiles; t += kOrderThreads)
    plan.runs(plan.list(t), [&](int kind, int32_t, int32_t run) { atomicAdd(&next[kind], run); });
  __syncthreads();
  if (threadIdx.x < 32) {
    const int32_t sum = begin_classes(next);
    if (threadIdx.x == 0) total = sum;
  }
  __syncthreads();
  for (int t = threadIdx.x; t < tiles; t += kOrderThreads) {
    const CutList list = plan.list(t);
    const int32_t full = full_chunks(list.length, list.size), behind = full ? atomicAdd(&places, full) : 0;
    plan.runs(list, [&](int kind, int32_t first, int32_t run) {
      const int32_t to = atomicAdd(&next[kind], run);
      for (int32_t i = 0; i < run; ++i) {
        const int32_t c = first + i, begin = c * list.size;
        chunks[to + i] = {t, begin, c < full ? begin + list.size : list.length, behind + c};
      }
    });
  }
  for (int k = total + int(threadIdx.x); k < blocks; k += kOrderThreads) chunks[k] = {-1, 0, 0, 0};
  for (int64_t k = threadIdx.x; k < count; k += kOrderThreads) zeros[k] = 0;
}

template <class Length>
__global__ void __launch_bounds__(kOrderThreads)
    keep_tiles_kernel(const int32_t* halted, int tiles, Length length, Chunk* chunks) {
  if (!begin_work(halted)) return;
  const int t = blockIdx.x * kOrderThreads + threadIdx.x;
  if (t < tiles) chunks[t] = {t, 0, int32_t(length(t)), 0};
}

// Schedules the tiles' lists in chunks of `size`, the longest first. If there are too many tiles to sort, lists stay
// whole, in the order of the tiles. total: the sum of all lengths, or more.
template <class Length>
Schedule longest_first(const Queue& queue, int64_t tiles, const Length& length, int32_t size = kWhole,
                       int64_t total = 0) {
  const bool ordered = tiles <= kMostOrdered;
  const int64_t places = ordered ? total / size : 0;
  Chunk* chunks = queue.array<Chunk>(tiles + places);
  if (ordered)
    launch(queue, "order_chunks", order_chunks_kernel<LongestFirst<Length>>, 1, kOrderThreads, int(tiles),
           LongestFirst<Length>{length, size}, int(tiles + places), chunks, nullptr, 0);
  else
    launch(queue, "keep_tiles", keep_tiles_kernel<Length>, blocks_for(tiles, kOrderThreads), kOrderThreads, int(tiles),
           length, chunks);
  return {chunks, unsigned(tiles + places), unsigned(places), size};
}

}  // namespace cuda
}  // namespace gs
