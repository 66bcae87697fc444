#pragma once
// Listing the tiles that a splat reaches, by whole warps: a splat over a thousand tiles must not hold up 31 others.
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

// Called by all lanes of a warp, each with a splat of its own (an empty rectangle for none): put(at, tile, index) gets
// each of its tiles in the rectangle's order, at counting up from the splat's offset. Returns the number of this lane's
// tiles, and in `mask` a bit for each of the rectangle's first 64.
template <class Put>
__device__ int32_t warp_list_tiles(const Splat<float>& splat, TileRect rect, Image image, int64_t offset, int32_t index,
                                   uint64_t& mask, const Put& put) {
  const int lane = threadIdx.x & 31, columns = tile_count(image.width);
  const int own = (rect.x1 - rect.x0) * (rect.y1 - rect.y0);
  int32_t count = 0;
  mask = 0;
  if (own > 0 && own <= kOwnTiles) {
    const TileTest<float> test = make_tile_test(splat, rect, image.width, image.height);
    uint64_t bit = 1;
    for (int ty = rect.y0; ty < rect.y1; ++ty)
      for (int tx = rect.x0; tx < rect.x1; ++tx, bit <<= 1)
        if (tile_reached(test, tx, ty)) {
          mask |= bit;
          put(offset + count++, ty * columns + tx, index);
        }
  }
  for (unsigned large = __ballot_sync(kWarp, own > kOwnTiles); large; large &= large - 1) {
    const int owner = __ffs(large) - 1;
    const TileRect r = {from_lane(rect.x0, owner), from_lane(rect.y0, owner), from_lane(rect.x1, owner),
                        from_lane(rect.y1, owner)};
    const TileTest<float> test = make_tile_test(from_lane(splat, owner), r, image.width, image.height);
    const int64_t owner_offset = from_lane(offset, owner);
    const int32_t owner_index = from_lane(index, owner);
    const int wide = r.x1 - r.x0, total = wide * (r.y1 - r.y0);
    int32_t found = 0;
    for (int base = 0; base < total; base += 32) {
      const int k = base + lane, tx = r.x0 + k % wide, ty = r.y0 + k / wide;
      const bool reached = k < total && tile_reached(test, tx, ty);
      const unsigned hits = __ballot_sync(kWarp, reached);
      if (reached) put(owner_offset + found + __popc(hits & ((1u << lane) - 1)), ty * columns + tx, owner_index);
      found += __popc(hits);
      if (lane == owner && base < 64) mask |= uint64_t(hits) << base;
    }
    if (lane == owner) count = found;
  }
  return count;
}

}  // namespace cuda
}  // namespace gs
