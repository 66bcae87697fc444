#pragma once
// Makes the tiles' lists by two sorts of everything: of the splats by depth, then of their instances by tile. Instances
// are emitted in depth order, and the second sort keeps the order of those in one tile.
#include <cuda_runtime.h>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/cub.cuh>

#include "backend.h"
#include "each_tile.cuh"
#include "survey.cuh"

namespace gs {
namespace cuda {

constexpr int kEmitThreads = 256;
constexpr int kStaged = 2048;  // instances that a block gathers in its own memory
constexpr int kRanged = 8;     // neighbouring instances of a thread

static __global__ void __launch_bounds__(kEmitThreads)
    number_kernel(const int32_t* halted, int64_t n, int32_t* numbers) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kEmitThreads + threadIdx.x;
  if (i < n) numbers[i] = int32_t(i);
}

// Returns the splats by depth, ties by index: the sort is stable and starts from that order. Culled splats have no
// instances, so it does not matter where they come.
inline const int32_t* sort_by_depth(const Queue& queue, int64_t n, const float* depths) {
  int32_t *numbers = queue.array<int32_t>(n), *order = queue.array<int32_t>(n);
  uint32_t* sorted = queue.array<uint32_t>(n);
  launch(queue, "number", number_kernel, blocks_for(n, kEmitThreads), kEmitThreads, n, numbers);
  // Positive floats sort like their bits.
  const auto* keys = reinterpret_cast<const uint32_t*>(depths);
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, sorted, static_cast<const int32_t*>(numbers), order,
                                           int32_t(n), 0, 32, stream_of(queue));
  });
  queue.release(queue.context, numbers), queue.release(queue.context, sorted);
  return order;
}

static __global__ void __launch_bounds__(kEmitThreads)
    line_up_kernel(const int32_t* halted, int64_t n, const int32_t* order, const TileRecord* records,
                   TileRecord* lined) {
  if (!begin_work(halted)) return;
  const int64_t k = int64_t(blockIdx.x) * kEmitThreads + threadIdx.x;
  if (k < n) lined[k] = load_whole(records + order[k]);
}

// Returns the same splats with records by depth, which are then read one after the other.
inline Projected<float> line_up(const Queue& queue, int64_t n, const Projected<float>& in, const int32_t* order) {
  Projected<float> lined = in;
  lined.records = queue.array<TileRecord>(n);
  launch(queue, "line_up", line_up_kernel, blocks_for(n, kEmitThreads), kEmitThreads, n, order, in.records,
         lined.records);
  return lined;
}

// The number of instances of the k-th splat by depth.
struct CountInOrder {
  Projected<float> lined;
  __host__ __device__ int32_t operator()(int32_t k) const {
#ifdef __CUDA_ARCH__
    return reached_by(lined, k).count;
#else
    return k;
#endif
  }
};

// Returns the first instance of each splat, by depth.
inline const int32_t* find_offsets(const Queue& queue, int64_t n, const Projected<float>& lined) {
  int32_t* offsets = queue.array<int32_t>(n);
  const auto counts = thrust::make_transform_iterator(thrust::counting_iterator<int32_t>(0), CountInOrder{lined});
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, offsets, int32_t(n), stream_of(queue));
  });
  return offsets;
}

// The rectangle of a splat, empty behind the last one.
struct Rects {
  Projected<float> in;
  int64_t splats;
  __host__ __device__ TileRect operator()(int64_t splat) const {
#ifdef __CUDA_ARCH__
    if (splat < splats) return reached_by(in, int32_t(splat)).rect;
#endif
    return {};
  }
};

struct SlotCounts {
  Rects rects;
  __host__ __device__ int64_t operator()(int64_t splat) const { return slot_count(rects(splat)); }
};

// Takes the number of slots before a splat's and stores it with the rest of its SplatSlots, in whole memory sectors.
struct SlotsAt {
  Rects rects;
  SplatSlots* slots;
  int64_t splat;
  __host__ __device__ void operator=(int64_t first) const { slots[splat] = splat_slots(first, rects(splat)); }
};

struct Slots {
  Rects rects;
  SplatSlots* slots;
  __host__ __device__ SlotsAt operator()(int64_t splat) const { return {rects, slots, splat}; }
};

inline void find_slots(const Queue& queue, int64_t n, const Projected<float>& in, SplatSlots* slots) {
  const thrust::counting_iterator<int64_t> splats(0);
  const Rects rects{in, n};
  const auto counts = thrust::make_transform_iterator(splats, SlotCounts{rects});
  const auto first = thrust::make_transform_iterator(splats, Slots{rects, slots});
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, first, n + 1, stream_of(queue));
  });
}

// Writes the tile and the splat of every instance. A thread takes the k-th splat by depth. The warps of its block share
// the tiles of each splat without a mask, whose instances come in any order: the sort by tile parts them anyway. The
// block's instances lie side by side, so if they are few enough, it gathers them first and writes whole memory sectors.
template <class Key, int kRays>
__global__ void __launch_bounds__(kEmitThreads)
    emit_kernel(const int32_t* halted, int64_t n, int32_t instances, const int32_t* order, const int32_t* offsets,
                Projected<float> in, Projected<float> lined, Image image, Key* tiles, int32_t* splats) {
  if (!begin_work(halted)) return;
  __shared__ int32_t large[kEmitThreads], next[kEmitThreads], larges;  // next: the place of its next instance
  __shared__ Key staged_tiles[kStaged];
  __shared__ int32_t staged_splats[kStaged];
  if (threadIdx.x == 0) larges = 0;
  __syncthreads();
  const int64_t begin = int64_t(blockIdx.x) * kEmitThreads, end = begin + kEmitThreads, k = begin + threadIdx.x;
  const int32_t first = offsets[begin], count = (end < n ? offsets[end] : instances) - first;
  const bool staged = count <= kStaged;
  Key* const to_tiles = staged ? staged_tiles : tiles + first;
  int32_t* const to_splats = staged ? staged_splats : splats + first;
  if (k < n) {
    const int32_t splat = order[k];
    const Reached reached = reached_by(lined, int32_t(k));
    int32_t at = offsets[k] - first;
    if (reached.count && !reached.mask) {
      const int32_t u = atomicAdd(&larges, 1);
      large[u] = splat, next[u] = at;
    }
    each_tile(reached, tile_count(image.width), [&](const int (&its)[kTaken]) {
#pragma unroll
      for (const int tile : its)
        if (tile >= 0) to_tiles[at] = Key(tile), to_splats[at] = splat, ++at;
    });
  }
  __syncthreads();
  for (int u = 0; u < larges; ++u) {
    const int from = (threadIdx.x + 96 * u) % kEmitThreads;  // most have fewer tiles than the block has threads
    each_tested<kRays>(in, large[u], image, from, kEmitThreads, [&](int tile) {
      const int32_t at = atomicAdd(next + u, 1);
      to_tiles[at] = Key(tile), to_splats[at] = large[u];
    });
  }
  if (!staged) return;
  __syncthreads();
  for (int i = threadIdx.x; i < count; i += kEmitThreads)
    tiles[first + i] = staged_tiles[i], splats[first + i] = staged_splats[i];
}

// Finds where each tile's list begins. An instance begins the lists of all tiles after the previous instance's tile, up
// to its own. Behind the last instance the lists of all tiles that are left begin, and the last list ends.
template <class Key>
__global__ void __launch_bounds__(kEmitThreads)
    ranges_kernel(const int32_t* halted, int64_t instances, int64_t tiles, const Key* sorted, int64_t* ranges) {
  if (!begin_work(halted)) return;
  const int64_t first = (int64_t(blockIdx.x) * kEmitThreads + threadIdx.x) * kRanged;
  if (first > instances) return;
  int64_t tile = first ? int64_t(sorted[first - 1]) + 1 : 0;
  Key its[kRanged];
#pragma unroll
  for (int r = 0; r < kRanged; ++r) its[r] = first + r < instances ? sorted[first + r] : Key(0);
#pragma unroll
  for (int r = 0; r < kRanged; ++r) {
    const int64_t i = first + r, last = i < instances ? int64_t(its[r]) : i == instances ? tiles : -1;
    for (; tile <= last; ++tile) ranges[tile] = i;
  }
}

inline int bits_for(int64_t values) {
  int bits = 1;
  while ((int64_t(1) << bits) < values) ++bits;
  return bits;
}

// Emits the instances and sorts them by tile. Releases what it reads, and `made`, once they are emitted.
template <class Key>
void sort_by_tile(const Queue& queue, int64_t n, const Projected<float>& in, const TileRecord* made, Image image,
                  const int32_t* order, int64_t instances, const Binned& out) {
  const int64_t tiles = tiles_of(image);
  const Projected<float> lined = line_up(queue, n, in, order);
  const int32_t* offsets = find_offsets(queue, n, lined);
  Key* emitted = queue.array<Key>(instances);
  const auto emit = by_rays(in.rays, [](auto rays) { return emit_kernel<Key, rays>; });
  launch(queue, "emit", emit, blocks_for(n, kEmitThreads), kEmitThreads, n, int32_t(instances), order, offsets, in,
         lined, image, emitted, out.instances);
  queue.release(queue.context, order), queue.release(queue.context, offsets);
  queue.release(queue.context, lined.records);
  if (made) queue.release(queue.context, made);
  cub::DoubleBuffer<Key> keys(emitted, queue.array<Key>(instances));
  cub::DoubleBuffer<int32_t> splats(out.instances, queue.array<int32_t>(instances));
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, splats, int32_t(instances), 0, bits_for(tiles),
                                           stream_of(queue));
  });
  if (splats.Current() != out.instances)  // after an odd number of passes, of 7 or 8 bits each
    GS_CUDA_CHECK(cudaMemcpyAsync(out.instances, splats.Current(), instances * sizeof(int32_t),
                                  cudaMemcpyDeviceToDevice, stream_of(queue)));
  launch(queue, "ranges", ranges_kernel<Key>, blocks_for(instances / kRanged + 1, kEmitThreads), kEmitThreads,
         instances, tiles, keys.Current(), out.ranges);
}

// Bins splats that have records and at least one instance. made: the records, if they are to be released, or null.
inline void sort_lists(const Queue& queue, int64_t n, const Projected<float>& in, const TileRecord* made, Image image,
                       const BinMemory& memory, const Survey& seen) {
  const int32_t* order = sort_by_depth(queue, n, in.depths);
  if (memory.slots) find_slots(queue, n, in, memory.slots);
  const Binned out = memory.take(memory.context, seen.instances, memory.slots ? seen.slots : 0);
  const auto sort = tiles_of(image) < 1 << 16 ? sort_by_tile<uint16_t> : sort_by_tile<uint32_t>;
  sort(queue, n, in, made, image, order, seen.instances, out);
}

}  // namespace cuda
}  // namespace gs
