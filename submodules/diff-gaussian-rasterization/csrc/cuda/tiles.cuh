#pragma once
// Counting the tiles that a splat reaches, by whole warps: a splat over a thousand tiles must not hold up 31 others.
#include "../launch.h"
#include "../math/tiles.h"

namespace gs {
namespace cuda {

using namespace baseline;  // the math headers' namespace in a build without instruction sets

constexpr unsigned kWarp = 0xffffffffu;
constexpr int kOwnTiles = 24;  // rectangles up to this size are a lane's own business

template <class V>
__device__ V from_lane(V value, int lane) {
  return __shfl_sync(kWarp, value, lane);
}

template <>
__device__ inline Splat<float> from_lane(Splat<float> s, int lane) {
  return {from_lane(s.x, lane),
          from_lane(s.y, lane),
          from_lane(s.l11, lane),
          from_lane(s.l12, lane),
          from_lane(s.l22, lane),
          from_lane(s.log2_opacity, lane),
          s.r,
          s.g,
          s.b,
          s.inverse_depth};
}

// Called by all lanes of a warp, each with a splat of its own (an empty rectangle for none). Returns the number of
// tiles that the splat reaches, and in `mask` a bit for each of the rectangle's first 64.
__device__ inline int32_t warp_count_tiles(const Splat<float>& splat, TileRect rect, Image image, uint64_t& mask) {
  const int lane = threadIdx.x & 31;
  const int own = (rect.x1 - rect.x0) * (rect.y1 - rect.y0);
  int32_t count = 0;
  mask = 0;
  if (own > 0 && own <= kOwnTiles) {
    const TileTest<float> test = make_tile_test(splat, rect, image.width, image.height);
    uint64_t bit = 1;
    for (int ty = rect.y0; ty < rect.y1; ++ty)
      for (int tx = rect.x0; tx < rect.x1; ++tx, bit <<= 1)
        if (tile_reached(test, float(tx), float(ty))) mask |= bit;
    count = __popcll(mask);
  }
  for (unsigned large = __ballot_sync(kWarp, own > kOwnTiles); large; large &= large - 1) {
    const int owner = __ffs(large) - 1;
    const TileRect r = {from_lane(rect.x0, owner), from_lane(rect.y0, owner), from_lane(rect.x1, owner),
                        from_lane(rect.y1, owner)};
    const TileTest<float> test = make_tile_test(from_lane(splat, owner), r, image.width, image.height);
    const int wide = r.x1 - r.x0, total = wide * (r.y1 - r.y0);
    int32_t found = 0;
    for (int base = 0; base < total; base += 32) {
      const int k = base + lane, tx = r.x0 + k % wide, ty = r.y0 + k / wide;
      const unsigned hits = __ballot_sync(kWarp, k < total && tile_reached(test, float(tx), float(ty)));
      found += __popc(hits);
      if (lane == owner && base < 64) mask |= uint64_t(hits) << base;
    }
    if (lane == owner) count = found;
  }
  return count;
}

}  // namespace cuda
}  // namespace gs
