#pragma once
// The tiles that a splat reaches, one after the other.
#include "cuda/project/splat_row.cuh"
#include "cuda/project/tile_record.cuh"
#include "cuda/project/tiles.cuh"

namespace gs {
namespace cuda {

constexpr int kTaken = 4;  // tiles whose memory accesses do not wait for each other

// Calls take(tiles) for the tiles that a splat reaches by its mask, kTaken at a time; -1 stands for none.
template <class Take>
__device__ __forceinline__ void each_tile(const Reached& reached, int columns, const Take& take) {
  const TileRect& rect = reached.rect;
  const int wide = rect.x1 - rect.x0, corner = rect.y0 * columns + rect.x0;
  const float inverse = 1 / float(wide);
  for (uint64_t mask = reached.mask; mask;) {
    int tiles[kTaken];
#pragma unroll
    for (int& tile : tiles) {
      // Adding a half keeps the quotient off whole numbers, so that rounding does not matter.
      const int place = __ffsll(mask) - 1, row = int((float(place) + 0.5f) * inverse);
      tile = mask ? corner + place + row * (columns - wide) : -1;
      mask &= mask - 1;
    }
    take(tiles);
  }
}

// Calls take(tile) for the tiles that a splat without a mask reaches: of the places first, first + step, ... of its
// rectangle.
template <int kRays, class Take>
__device__ __forceinline__ void each_tested(const Projected<float>& in, int32_t splat, Image image, int first, int step,
                                            const Take& take) {
  const TileRect rect = reached_by(in, splat).rect;
  const auto test = test_of(load_shape<kRays>(in.splats, splat), rect, image, in.table);
  const int wide = rect.x1 - rect.x0, area = wide * (rect.y1 - rect.y0);
  for (int place = first; place < area; place += step) {
    const int x = rect.x0 + place % wide, y = rect.y0 + place / wide;
    if (tile_reached<true>(test, float(x), float(y))) take(y * tile_count(image.width) + x);
  }
}

}  // namespace cuda
}  // namespace gs
