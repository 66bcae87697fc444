#pragma once
// Writes the instances (tile, splat) in depth order. Blocks share the instances evenly, not the splats: the nearest
// splats lie side by side in that order and reach a thousand tiles each.
#include "splat_row.cuh"
#include "tile_record.cuh"
#include "tiles.cuh"

namespace gs {
namespace cuda {

constexpr int kEmitThreads = 256;
constexpr int kEmitRun = 4;  // instances of a thread, side by side, stored at once
constexpr int kEmitted = kEmitRun * kEmitThreads;

// The place of the n-th set bit, n from 0.
__device__ inline int nth_bit(uint64_t mask, int n) {
  int place = 0;
  for (int half = 32; half; half /= 2) {
    const int below = __popcll(mask & ((uint64_t(1) << half) - 1));
    if (n >= below) {
      n -= below;
      place += half;
      mask >>= half;
    }
  }
  return place;
}

// The data of a splat that emission needs.
struct alignas(16) Lined {
  uint64_t mask;   // of reached tiles, 0 where emission has to test them
  int32_t corner;  // the first tile of the rectangle
  int32_t wide;
};

// Copies this data of the splats into depth order, so that scattered memory is read only once. counts:
// (n + 1), the last 0.
__global__ void __launch_bounds__(kEmitThreads)
    line_up_kernel(const int32_t* halted, int64_t n, const int32_t* order, Projected<float> in, int columns,
                   Lined* lined, int32_t* counts) {
  const int64_t k = int64_t(blockIdx.x) * kEmitThreads + threadIdx.x;
  const bool empty = is_halted(halted);  // the sum of counts that nobody wrote could overflow
  if (k == n || (empty && k < n)) counts[k] = 0;
  if (k >= n || empty) return;
  const Reached reached = reached_by(in, order[k]);
  const TileRect rect = reached.rect;
  counts[k] = reached.count;
  lined[k] = {reached.mask, rect.y0 * columns + rect.x0, rect.x1 - rect.x0};
}

// Finds for each block the splat of its first instance; the entry after the last block gets the last splat with an
// instance. Splats count in depth order. offsets: (n + 1), the first instance of each splat.
__global__ void __launch_bounds__(kEmitThreads)
    share_kernel(const int32_t* halted, int64_t n, const int32_t* offsets, int32_t* first) {
  if (is_halted(halted)) return;
  const int64_t k = int64_t(blockIdx.x) * kEmitThreads + threadIdx.x;
  if (k >= n) return;
  const int64_t begin = offsets[k], end = offsets[k + 1], instances = offsets[n];
  if (begin == end) return;
  for (int64_t block = (begin + kEmitted - 1) / kEmitted; block * kEmitted < end; ++block) first[block] = int32_t(k);
  if (end == instances) first[(instances + kEmitted - 1) / kEmitted] = int32_t(k);
}

// The splats that a block's instances belong to, in shared memory.
struct EmittedSplats {
  Lined line[kEmitted];
  int32_t first[kEmitted];  // the splat's first instance, counted from the block's
  int32_t index[kEmitted];
  int32_t starting[kEmitted];         // by instance: the splat that begins there, or 0
  uint16_t unmasked[kEmitted];        // splats without a mask, in any order
  int32_t latest[kEmitThreads / 32];  // the last splat that begins in a warp's instances
  int32_t unmasked_count;

  __device__ void put(int at, int32_t splat, int32_t first_instance, const Lined& lined) {
    line[at] = lined, first[at] = first_instance, index[at] = splat;
    if (first_instance > 0) starting[first_instance] = at;
    if (!lined.mask) unmasked[atomicAdd(&unmasked_count, 1)] = uint16_t(at);
  }
};

// The tile at a place below 64 of a rectangle. Adding a half keeps the quotient off whole numbers, so that rounding
// does not matter.
__device__ inline int tile_at(const Lined& line, int place, int columns) {
  const int row = int((float(place) + 0.5f) / float(line.wide));
  return line.corner + place + row * (columns - line.wide);
}

template <class T>
struct alignas(kEmitRun * sizeof(T)) EmitRun {
  T of[kEmitRun];
};

// Fills `splats` with the splats first to last of the depth order, whose instances lie in the block's range.
__device__ __forceinline__ void gather_splats(EmittedSplats& splats, int64_t base, int emitted, int32_t first,
                                              int32_t last, const int32_t* order, const Lined* lined,
                                              const int32_t* offsets) {
  for (int j = threadIdx.x; j < kEmitted; j += kEmitThreads) splats.starting[j] = 0;
  if (threadIdx.x == 0) splats.unmasked_count = 0;
  __syncthreads();
  for (int k = threadIdx.x; k <= last - first; k += kEmitThreads) {
    const int64_t begin = offsets[first + k] - base;
    const Lined line = lined[first + k];
    const int32_t index = order[first + k];
    if (begin < emitted) splats.put(k, index, int32_t(begin), line);
  }
  __syncthreads();
}

// Finds the splat that the instance before the thread's first one belongs to. Splats begin in the order of their
// numbers, so it is the largest number so far. starting: of the thread's own instances.
__device__ __forceinline__ int find_owner(EmittedSplats& splats, const EmitRun<int32_t>& starting, int warp, int lane) {
  int k = 0;
  for (int r = 0; r < kEmitRun; ++r) k = starting.of[r] > k ? starting.of[r] : k;
  for (int step = 1; step < 32; step *= 2) {
    const int before = __shfl_up_sync(kWarp, k, step);
    if (lane >= step && before > k) k = before;
  }
  if (lane == 31) splats.latest[warp] = k;
  k = __shfl_up_sync(kWarp, k, 1);
  if (lane == 0) k = 0;
  __syncthreads();
  for (int w = 0; w < warp; ++w) k = splats.latest[w] > k ? splats.latest[w] : k;
  return k;
}

// Writes the thread's instances by the masks of their splats; any tile for a splat without a mask. Behind the last
// instance come any splats in the tile `behind`.
template <class Key>
__device__ __forceinline__ void emit_masked(EmittedSplats& splats, int64_t base, int emitted, int columns, Key behind,
                                            int warp, int lane, Key* tiles, int32_t* owners) {
  const EmitRun<int32_t> starting = reinterpret_cast<const EmitRun<int32_t>*>(splats.starting)[threadIdx.x];
  int k = find_owner(splats, starting, warp, lane);
  const int at = kEmitRun * threadIdx.x;
  Lined line = splats.line[k];
  if (!starting.of[0]) line.mask &= ~uint64_t(0) << nth_bit(line.mask, at - splats.first[k]);
  EmitRun<Key> run_tiles;
  EmitRun<int32_t> run_owners;
#pragma unroll
  for (int r = 0; r < kEmitRun; ++r) {
    if (starting.of[r]) k = starting.of[r], line = splats.line[k];
    run_tiles.of[r] = at + r < emitted ? Key(tile_at(line, (__ffsll(line.mask) - 1) & 63, columns)) : behind;
    run_owners.of[r] = splats.index[k];
    line.mask &= line.mask - 1;
  }
  reinterpret_cast<EmitRun<Key>*>(tiles + base)[threadIdx.x] = run_tiles;
  reinterpret_cast<EmitRun<int32_t>*>(owners + base)[threadIdx.x] = run_owners;
}

using WarpHits = int32_t[2][kEmitThreads / 32];  // a row for every other turn

// Writes the instances of splats without a mask over what emit_masked left there. The whole block tests such a splat's
// tiles again, as far as the block's instances go.
template <class Key>
__device__ __forceinline__ void emit_unmasked(const EmittedSplats& splats, WarpHits& warp_hits,
                                              const Projected<float>& in, Image image, int columns, int64_t base,
                                              int emitted, int warp, int lane, Key* tiles, int32_t* owners) {
  if (splats.unmasked_count) __syncthreads();  // emit_masked is done in every thread
  for (int u = 0, turn = 0; u < splats.unmasked_count; ++u) {
    const int32_t k = splats.unmasked[u], index = splats.index[k];
    const TileRect rect = reached_by(in, index).rect;
    const TileTest<float> test = make_tile_test(load_shape(in.splats, index), rect, image.width, image.height);
    const int wide = rect.x1 - rect.x0, area = wide * (rect.y1 - rect.y0);
    int at = splats.first[k];
    for (int tile = 0; tile < area && at < emitted; tile += kEmitThreads, turn ^= 1) {
      const int mine = tile + threadIdx.x, tx = rect.x0 + mine % wide, ty = rect.y0 + mine / wide;
      const bool reached = mine < area && tile_reached(test, float(tx), float(ty));
      const unsigned hits = __ballot_sync(kWarp, reached);
      if (lane == 0) warp_hits[turn][warp] = __popc(hits);
      __syncthreads();  // one barrier is enough: the next turn writes the other row
      int before = __popc(hits & ((1u << lane) - 1)), all = 0;
      for (int w = 0; w < kEmitThreads / 32; ++w) {
        if (w < warp) before += warp_hits[turn][w];
        all += warp_hits[turn][w];
      }
      if (reached && at + before >= 0 && at + before < emitted) {
        tiles[base + at + before] = Key(ty * columns + tx);
        owners[base + at + before] = index;
      }
      at += all;
    }
  }
}

// Writes the tile and the splat of every instance, in depth order. order: the n splats by depth; tiles and owners have
// room for whole blocks. What is left of that room gets the tile behind the last one, so that it is sorted last.
template <class Key>
__global__ void __launch_bounds__(kEmitThreads)
    emit_kernel(const int32_t* halted, int64_t n, const int32_t* order, const Lined* lined, const int32_t* offsets,
                const int32_t* first_splat, Projected<float> in, Image image, Key* tiles, int32_t* owners) {
  if (is_halted(halted)) return;
  __shared__ EmittedSplats splats;
  __shared__ WarpHits warp_hits;
  const int columns = tile_count(image.width), warp = threadIdx.x / 32, lane = threadIdx.x & 31;
  const int64_t base = int64_t(blockIdx.x) * kEmitted, instances = offsets[n];
  const Key behind = Key(tiles_of(image));
  if (base >= instances) {
    for (int j = threadIdx.x; j < kEmitted; j += kEmitThreads) tiles[base + j] = behind;
    return;
  }
  const int emitted = int(instances - base < kEmitted ? instances - base : kEmitted);
  const int32_t first = first_splat[blockIdx.x], last = first_splat[blockIdx.x + 1];
  gather_splats(splats, base, emitted, first, last, order, lined, offsets);
  emit_masked(splats, base, emitted, columns, behind, warp, lane, tiles, owners);
  emit_unmasked(splats, warp_hits, in, image, columns, base, emitted, warp, lane, tiles, owners);
}

}  // namespace cuda
}  // namespace gs
