#pragma once
// Writing the instances (tile, splat) in depth order. Blocks share the instances evenly, not the splats: the nearest
// splats lie side by side in that order and reach a thousand tiles each.
#include "tiles.cuh"

namespace gs {
namespace cuda {

constexpr int kEmitThreads = 256;
constexpr int kEmitted = 1024;  // instances of a block

// The place of the n-th set bit (from 0).
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

// The last k with offsets[k] <= value, found by a warp; offsets ascend from 0.
__device__ inline int64_t last_at_most(const int64_t* offsets, int64_t n, int64_t value) {
  int64_t low = 0, high = n;
  while (high - low > 1) {
    const int64_t step = (high - low + 31) / 32, probe = low + (threadIdx.x & 31) * step;
    const int hits = __popc(__ballot_sync(kWarp, probe < high && offsets[probe] <= value));
    low += (hits - 1) * step;
    high = low + step < high ? low + step : high;
  }
  return low;
}

// The splats that a block's instances belong to, in shared memory.
struct EmittedSplats {
  int32_t first[kEmitted];  // the splat's first instance, counted from the block's
  int32_t index[kEmitted];
  int32_t x0[kEmitted], y0[kEmitted], wide[kEmitted];  // of its rectangle
  uint64_t mask[kEmitted];                             // of reached tiles; 0 where the rectangle has more than 64
  int32_t unmasked[kEmitted];                          // the places of those, in any order
  int32_t unmasked_count;

  __device__ void put(int at, int32_t splat, int64_t first_instance, const Projected<float>& in) {
    TileRect rect;
    uint64_t reached = 0;
    if (in.records) {
      const TileRecord record = in.records[splat];
      rect = {record.x0, record.y0, record.x1, record.y1};
      reached = record.mask;
    } else {
      const int4 r = reinterpret_cast<const int4*>(in.rects)[splat];
      rect = {r.x, r.y, r.z, r.w};
    }
    const bool masked = in.records && (rect.x1 - rect.x0) * (rect.y1 - rect.y0) <= 64;
    first[at] = int32_t(first_instance), index[at] = splat;
    x0[at] = rect.x0, y0[at] = rect.y0, wide[at] = rect.x1 - rect.x0;
    mask[at] = masked ? reached : 0;
    if (!masked) unmasked[atomicAdd(&unmasked_count, 1)] = at;
  }

  // The splat of instance j.
  __device__ int owner(int j, int count) const {
    int low = 0;
    for (int high = count; high - low > 1;) {
      const int middle = (low + high) / 2;
      (first[middle] <= j ? low : high) = middle;
    }
    return low;
  }
};

__device__ inline Splat<float> load_shape(const float* splats, int32_t index) {
  const float2* from = reinterpret_cast<const float2*>(splats + kSplatValues * int64_t(index));
  const float2 mean = from[0], l1 = from[1], l2 = from[2];
  return {mean.x, mean.y, l1.x, l1.y, l2.x, l2.y, 0, 0, 0, 0};
}

// order: splats by depth; offsets: the first instance of each in that order. A splat over more tiles than a mask has
// bits for is tested again, by the whole block, as far as the block's instances go.
template <class Key>
__global__ void __launch_bounds__(kEmitThreads)
    emit_kernel(int64_t n, int64_t instances, const int32_t* order, const int64_t* offsets, Projected<float> in,
                Image image, Key* tiles, int32_t* owners, int64_t* slot_offsets) {
  __shared__ EmittedSplats splats;
  __shared__ int64_t ends[2];
  __shared__ int32_t warp_hits[2][kEmitThreads / 32];
  const int columns = tile_count(image.width), warp = threadIdx.x / 32, lane = threadIdx.x & 31;
  const int64_t base = int64_t(blockIdx.x) * kEmitted;
  const int emitted = int(instances - base < kEmitted ? instances - base : kEmitted);
  if (warp < 2) {
    const int64_t k = last_at_most(offsets, n, warp ? base + emitted - 1 : base);
    if (lane == 0) ends[warp] = k;
  }
  if (threadIdx.x == 0) splats.unmasked_count = 0;
  __syncthreads();
  const int64_t first = ends[0];
  const int count = int(ends[1] - first) + 1;
  for (int k = threadIdx.x; k < count; k += kEmitThreads) {
    const int32_t index = order[first + k];
    const int64_t offset = offsets[first + k];
    splats.put(k, index, offset - base, in);
    if (slot_offsets && offset >= base) slot_offsets[index] = offset;
  }
  __syncthreads();

  for (int j = threadIdx.x; j < emitted; j += kEmitThreads) {
    const int k = splats.owner(j, count);
    const uint64_t mask = splats.mask[k];
    if (!mask) continue;
    const int wide = splats.wide[k], bit = nth_bit(mask, j - splats.first[k]), row = bit / wide;
    tiles[base + j] = Key((splats.y0[k] + row) * columns + splats.x0[k] + bit - row * wide);
    owners[base + j] = splats.index[k];
  }

  for (int u = 0, turn = 0; u < splats.unmasked_count; ++u) {
    const int k = splats.unmasked[u];
    const int32_t index = splats.index[k];
    const int x0 = splats.x0[k], y0 = splats.y0[k], wide = splats.wide[k];
    const int high = (in.records ? in.records[index].y1 : in.rects[4 * int64_t(index) + 3]) - y0;
    const TileTest<float> test =
        make_tile_test(load_shape(in.splats, index), TileRect{x0, y0, x0 + wide, y0 + high}, image.width, image.height);
    int at = splats.first[k];
    for (int tile = 0; tile < wide * high && at < emitted; tile += kEmitThreads, turn ^= 1) {
      const int mine = tile + threadIdx.x, tx = x0 + mine % wide, ty = y0 + mine / wide;
      const bool reached = mine < wide * high && tile_reached(test, float(tx), float(ty));
      const unsigned hits = __ballot_sync(kWarp, reached);
      if (lane == 0) warp_hits[turn][warp] = __popc(hits);
      __syncthreads();  // one is enough: the next turn writes the other row
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

}  // namespace cuda
}  // namespace gs
