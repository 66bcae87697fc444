// Binning by two small sorts instead of a large one: the splats by depth, then their instances by tile. The second sort
// is stable, and instances are emitted in depth order.
#include <cuda_runtime.h>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/cub.cuh>
#include <optional>

#include "../backend.h"
#include "../math/slots.h"
#include "ahead.cuh"
#include "host_numbers.cuh"
#include "instances.cuh"
#include "make_records.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

constexpr int kCounted = 4;  // splats of a thread; their loads do not wait for each other

// Adds the instances and slots of all splats to `totals`, and numbers the splats for the depth sort.
__global__ void __launch_bounds__(kThreads)
    count_kernel(const int32_t* halted, int64_t n, Projected<float> in, int32_t* index, unsigned long long* totals) {
  if (is_halted(halted)) return;
  __shared__ unsigned long long of_block[2];
  if (threadIdx.x < 2) of_block[threadIdx.x] = 0;
  __syncthreads();
  const int64_t first = int64_t(blockIdx.x) * kCounted * kThreads + threadIdx.x;
  unsigned long long instances = 0, slots = 0;
#pragma unroll
  for (int r = 0; r < kCounted; ++r) {
    const int64_t i = first + r * kThreads;
    const Reached reached = i < n ? reached_by(in, int32_t(i)) : Reached{};
    instances += reached.count, slots += slot_count(reached.rect);
    if (i < n) index[i] = int32_t(i);
  }
  for (int step = 16; step; step /= 2) {
    instances += __shfl_xor_sync(kWarp, instances, step);
    slots += __shfl_xor_sync(kWarp, slots, step);
  }
  if (threadIdx.x % 32 == 0) atomicAdd(of_block, instances), atomicAdd(of_block + 1, slots);
  __syncthreads();
  if (threadIdx.x < 2) atomicAdd(totals + threadIdx.x, of_block[threadIdx.x]);
}

// Counts all instances and slots. Fills `index` with the splats' numbers.
const int64_t* count_all(const Queue& queue, int64_t n, const Projected<float>& in, int32_t* index) {
  auto* totals = queue.array<unsigned long long>(2);
  GS_CUDA_CHECK(cudaMemsetAsync(totals, 0, 2 * sizeof *totals, stream_of(queue)));
  count_kernel<<<blocks_for(n, kCounted * kThreads), kThreads, 0, stream_of(queue)>>>(queue.halted, n, in, index,
                                                                                      totals);
  check_launch("count");
  return reinterpret_cast<const int64_t*>(totals);
}

__global__ void judge_lists_kernel(Ahead ahead, const int64_t* totals) { judge_lists(ahead, totals[0], totals[1]); }

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

// The keys of one load from memory.
template <class Key>
struct alignas(16) Keys {
  static constexpr int kCount = 16 / sizeof(Key);
  Key of[kCount];
};

// Finds where each tile's list begins. An instance begins the lists of all tiles after the previous instance's tile, up
// to its own. What stands behind the last instance belongs to the tile behind the last one.
template <class Key>
__global__ void ranges_kernel(const int32_t* halted, int64_t instances, int64_t tiles, const Key* sorted,
                              int64_t* ranges) {
  if (is_halted(halted)) return;
  constexpr int kCount = Keys<Key>::kCount;
  const int64_t first = (int64_t(blockIdx.x) * kThreads + threadIdx.x) * kCount;
  if (first > instances) return;
  int64_t tile = first == 0 ? 0 : int64_t(sorted[first - 1]) + 1;
  Keys<Key> keys{};
  if (first + kCount <= instances)
    keys = *reinterpret_cast<const Keys<Key>*>(sorted + first);
  else
    for (int r = 0; first + r < instances; ++r) keys.of[r] = sorted[first + r];
#pragma unroll
  for (int r = 0; r < kCount; ++r) {
    const int64_t i = first + r;
    const int64_t to = i < instances ? int64_t(keys.of[r]) : i == instances ? tiles : -1;
    for (; tile <= to; ++tile) ranges[tile] = i;
  }
}

int bits_for(int64_t values) {
  int bits = 1;
  while ((int64_t(1) << bits) < values) ++bits;
  return bits;
}

// Sorts splats by depth, ties by index: the sort is stable and starts from that order. Culled splats are infinitely far
// and come last.
const int32_t* sort_by_depth(const Queue& queue, int64_t n, const float* depths, const int32_t* index) {
  uint32_t* sorted_keys = queue.array<uint32_t>(n);
  int32_t* order = queue.array<int32_t>(n);
  // Positive floats sort like their bits.
  const uint32_t* keys = reinterpret_cast<const uint32_t*>(depths);
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, sorted_keys, index, order, n, 0, 32, stream_of(queue));
  });
  return order;
}

void find_slots(const Queue& queue, int64_t n, const Projected<float>& in, SplatSlots* slots) {
  const thrust::counting_iterator<int64_t> splats(0);
  const Rects rects{in, n};
  const auto counts = thrust::make_transform_iterator(splats, SlotCounts{rects});
  const auto first = thrust::make_transform_iterator(splats, Slots{rects, slots});
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, first, n + 1, stream_of(queue));
  });
}

// Emits the instances and sorts them by tile. order: the splats by depth. room: for at least all instances. last_read:
// memory to release once the instances are emitted, or null.
template <class Key>
void bin_with(const Queue& queue, int64_t n, const Projected<float>& in, const int32_t* order, Image image,
              int64_t room, const void* last_read, const Binned& out) {
  const int64_t tiles = tiles_of(image);
  const cudaStream_t stream = stream_of(queue);
  const int64_t blocks = (room + kEmitted - 1) / kEmitted;
  Key *keys = queue.array<Key>(blocks * kEmitted), *sorted_keys = queue.array<Key>(blocks * kEmitted);
  if (room) {
    Lined* lined = queue.array<Lined>(n);
    int32_t *counts = queue.array<int32_t>(n + 1), *offsets = queue.array<int32_t>(n + 1);
    int32_t* first = queue.array<int32_t>(blocks + 1);
    const unsigned splat_blocks = unsigned(n / kEmitThreads + 1);
    line_up_kernel<<<splat_blocks, kEmitThreads, 0, stream>>>(queue.halted, n, order, in, tile_count(image.width),
                                                              lined, counts);
    check_launch("line_up");
    with_memory(queue, [&](void* memory, size_t& bytes) {
      return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, offsets, n + 1, stream);
    });
    share_kernel<<<splat_blocks, kEmitThreads, 0, stream>>>(queue.halted, n, offsets, first);
    check_launch("share");
    int32_t* owners = queue.array<int32_t>(blocks * kEmitted);
    emit_kernel<Key><<<unsigned(blocks), kEmitThreads, 0, stream>>>(queue.halted, n, order, lined, offsets, first, in,
                                                                    image, keys, owners);
    check_launch("emit");
    if (last_read) queue.release(queue.context, last_read);
    with_memory(queue, [&](void* memory, size_t& bytes) {
      return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, sorted_keys, owners, out.instances, room, 0,
                                             bits_for(tiles + 1), stream);
    });
  }
  const int64_t loads = room / Keys<Key>::kCount + 1;
  ranges_kernel<Key>
      <<<blocks_for(loads, kThreads), kThreads, 0, stream>>>(queue.halted, room, tiles, sorted_keys, out.ranges);
  check_launch("bin");
}

}  // namespace

template <>
void bin<float>(const Queue& queue, int64_t count, const Projected<float>& given, Image image,
                const BinMemory& memory) {
  Projected<float> in = given;
  TileRecord* made = nullptr;
  if (count && !in.records && has_records(image)) in.records = made = make_records(queue, count, in, image);
  int64_t instances = 0, slots = 0;
  const int32_t* order = nullptr;
  if (count) {
    int32_t* index = queue.array<int32_t>(count);
    const int64_t* counted = count_all(queue, count, in, index);
    std::optional<HostNumbers<int64_t>> totals;
    if (memory.ahead) {
      judge_lists_kernel<<<1, 1, 0, stream_of(queue)>>>(*memory.ahead, counted);
      check_launch("judge_lists");
    } else {
      totals.emplace(queue, counted, 2);
    }
    // If the host waits for the numbers, the GPU does the work that needs no list.
    order = sort_by_depth(queue, count, in.depths, index);
    if (memory.slots) find_slots(queue, count, in, memory.slots);
    instances = totals ? totals->wait()[0] : memory.ahead->room.instances;
    if (memory.slots) slots = totals ? totals->wait()[1] : memory.ahead->room.slots;
  } else if (memory.slots) {
    GS_CUDA_CHECK(cudaMemsetAsync(memory.slots, 0, sizeof *memory.slots, stream_of(queue)));
  }
  const Binned out = memory.take(memory.context, instances, slots);
  const int64_t tiles = tiles_of(image);
  const auto run = tiles < 1 << 16 ? bin_with<uint16_t> : bin_with<uint32_t>;
  run(queue, count, in, order, image, instances, made, out);
}

}  // namespace cuda
}  // namespace gs
