#pragma once
// Counts the tiles that a splat reaches, by whole warps: a splat over a thousand tiles must not hold up 31 others.
#include "cuda/queue/queue.cuh"
#include "data.h"
#include "math/lens_pixels.h"

namespace gs {
namespace cuda {

using namespace baseline;  // the math headers' namespace in a build without instruction sets

constexpr int kShared = 32;  // rectangles of at most this many tiles are pooled across the warp

template <class V>
__device__ V from_lane(V value, int lane) {
  return __shfl_sync(kWarp, value, lane);
}

// Take over what tile_reached reads and what differs between lanes.
template <>
__device__ inline TileTest<float> from_lane(TileTest<float> test, int lane) {
  Splat<float>& s = test.splat;
  s.x = from_lane(s.x, lane), s.y = from_lane(s.y, lane);
  s.l11 = from_lane(s.l11, lane), s.l22 = from_lane(s.l22, lane);
  test.slope_x = from_lane(test.slope_x, lane), test.slope_y = from_lane(test.slope_y, lane);
  test.level = from_lane(test.level, lane);
  return test;
}
template <>
__device__ inline RayTileTest<float> from_lane(RayTileTest<float> test, int lane) {
  TileTest<float>& flat = test;
  flat = from_lane(flat, lane);
  test.by_x = from_lane(test.by_x, lane), test.by_y = from_lane(test.by_y, lane);
  test.reach = from_lane(test.reach, lane), test.margin = from_lane(test.margin, lane);
  return test;
}

template <>
__device__ inline LensTileTest<float> from_lane(LensTileTest<float> test, int lane) {
  for (Vec3<float>* a : {&test.u, &test.v, &test.s})
    *a = {from_lane(a->x, lane), from_lane(a->y, lane), from_lane(a->z, lane)};
  test.e = from_lane(test.e, lane), test.log2_opacity = from_lane(test.log2_opacity, lane);
  return test;
}

// As for others, by the frame of the tile.
template <bool kMayCross>
__device__ inline bool tile_reached(const LensTileTest<float>& test, float x, float y) {
  const float4* row = reinterpret_cast<const float4*>(test.table + kFrameValues * (int(y) * test.columns + int(x)));
  const float4 a = row[0], b = row[1], c = row[2], d = row[3];
  const float frame[] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w, d.x};
  return frame_reached(test, frame);
}

// The test of a splat, whatever it is.
template <class AnySplat>
__device__ inline auto test_of(const AnySplat& splat, TileRect rect, Image image, const float*) {
  return make_tile_test(splat, rect, image.width, image.height);
}
__device__ inline LensTileTest<float> test_of(const LensRaySplat<float>& splat, TileRect, Image image,
                                              const float* table) {
  return make_tile_test(splat, image, table);
}
template <class Test, class AnySplat>
__device__ inline Test test_of_none(const AnySplat& splat, Image image, const float*) {
  Test test = {};
  test.splat = splat, test.last_x = float(image.width - 1), test.last_y = float(image.height - 1);
  return test;
}
template <>
__device__ inline LensTileTest<float> test_of_none(const LensRaySplat<float>&, Image image, const float* table) {
  LensTileTest<float> test = {};
  test.table = table, test.columns = tile_count(image.width);
  return test;
}

// Tests the tiles of every lane's rectangle: 1 to 32 `tiles` in rows of `wide` from (x0, y0). All lanes of a warp call
// this, and share all tests evenly. Returns a bit for each of the lane's own tiles that is reached. kMayCross: as for
// tile_reached.
template <bool kMayCross, class Test>
__device__ inline uint32_t warp_tiles_reached(const Test& test, int x0, int y0, int wide, int tiles) {
  const int lane = threadIdx.x & 31;
  const int inverse = int(__fdividef(1024, float(wide))) + 1;  // k * inverse >> 10 is k / wide for all k < 32
  int end = tiles;
  for (int step = 1; step < 32; step *= 2) {
    const int before = __shfl_up_sync(kWarp, end, step);
    if (lane >= step) end += before;
  }
  const unsigned start = end - tiles, total = from_lane(end, 31);
  unsigned kept = 0;  // lane k keeps round k's hits
  for (unsigned base = 0, begun = 0; base < total; base += 32) {
    const unsigned in_round = start - base;
    const unsigned starts = warp_or(in_round < 32 ? 1u << in_round : 0u);
    const int owner = begun + __popc(starts & ((2u << lane) - 1)) - 1;
    begun += __popc(starts);
    const int k = int(base + lane - from_lane(start, owner)), row = k * from_lane(inverse, owner) >> 10;
    const int tx = from_lane(x0, owner) + k - row * from_lane(wide, owner), ty = from_lane(y0, owner) + row;
    const unsigned hits = __ballot_sync(kWarp, tile_reached<kMayCross>(from_lane(test, owner), float(tx), float(ty)));
    if (lane == int(base / 32)) kept = hits;
  }
  const uint64_t low = from_lane(kept, start / 32), high = from_lane(kept, start / 32 + 1);
  return uint32_t((high << 32 | low) >> start % 32) & uint32_t((uint64_t(1) << tiles) - 1);
}

// Returns the number of tiles that the lane's splat reaches, and in `mask` a bit for each of its rectangle's first 64.
// All lanes of a warp call this; a lane without a splat gives an empty rectangle.
template <bool kMayCross, class AnySplat>
__device__ inline int32_t warp_count_tiles(const AnySplat& splat, TileRect rect, Image image, const float* table,
                                           uint64_t& mask) {
  using Test = decltype(test_of(splat, rect, image, table));
  const int lane = threadIdx.x & 31;
  const int wide = rect.x1 - rect.x0, tiles = wide * (rect.y1 - rect.y0);
  Test test = test_of_none<Test>(splat, image, table);
  if (tiles > 0) test = test_of(splat, rect, image, table);
  int32_t count = 0;
  mask = 0;
  const bool shared = tiles > 0 && tiles <= kShared;
  if (__any_sync(kWarp, shared)) {  // lanes without such a splat test one tile in vain
    const uint32_t reached =
        warp_tiles_reached<kMayCross>(test, rect.x0, rect.y0, shared ? wide : 1, shared ? tiles : 1);
    if (shared) mask = reached, count = __popc(reached);
  }
  for (unsigned large = __ballot_sync(kWarp, tiles > kShared); large; large &= large - 1) {
    const int owner = __ffs(large) - 1;
    const Test its = from_lane(test, owner);
    const int x0 = from_lane(rect.x0, owner), y0 = from_lane(rect.y0, owner);
    const int across = from_lane(wide, owner), total = from_lane(tiles, owner);
    int32_t found = 0;
    for (int base = 0; base < total; base += 32) {
      const int k = base + lane, tx = x0 + k % across, ty = y0 + k / across;
      const unsigned hits = __ballot_sync(kWarp, k < total && tile_reached<kMayCross>(its, float(tx), float(ty)));
      found += __popc(hits);
      if (lane == owner && base < 64) mask |= uint64_t(hits) << base;
    }
    if (lane == owner) count = found;
  }
  return count;
}

}  // namespace cuda
}  // namespace gs
