// The tiles that a splat reaches.
#include "../math/ray_pixels.h"
#include "gs/simd.h"
#include "list_tiles.h"

GS_ISA_BEGIN

namespace {

// Tests the rectangle's tiles row by row, a vector at a time.
template <class T, class AnySplat>
__attribute__((noinline)) int32_t list_tiles_of(const AnySplat& splat, TileRect rect, Image image, uint64_t& mask,
                                                int32_t* tiles) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  T lanes[S::kLanes];
  for (int i = 0; i < S::kLanes; ++i) lanes[i] = T(i);
  const V lane = S::load(lanes);
  const auto test = make_tile_test(splat, rect, image.width, image.height);
  const int wide = rect.x1 - rect.x0, columns = tile_count(image.width), total = wide * (rect.y1 - rect.y0);
  int32_t count = 0;
  mask = 0;
  int row = rect.y0, column = 0;
  for (int done = 0; done < total; done += S::kLanes) {
    const V along = lane + T(column);
    const M down = __builtin_convertvector((along + T(0.5)) / T(wide), M);
    const V x = along - __builtin_convertvector(down, V) * T(wide) + T(rect.x0);
    const V y = __builtin_convertvector(down, V) + T(row);
    uint32_t reached = S::bits(tile_reached(test, x, y));
    if (total - done < S::kLanes) reached &= (1u << (total - done)) - 1;
    if (total <= kMasked) mask |= uint64_t(reached) << done;
    if (tiles) {
      const M tile = (down + row) * columns + __builtin_convertvector(x, M);
      for (uint32_t bits = reached; bits; bits &= bits - 1) *tiles++ = int32_t(tile[__builtin_ctz(bits)]);
    }
    count += __builtin_popcount(reached);
    column += S::kLanes;
    row += column / wide, column %= wide;
  }
  return count;
}

}  // namespace

template <class T>
int32_t list_tiles(const Splat<T>& splat, TileRect rect, Image image, const T*, uint64_t& mask, int32_t* tiles) {
  return list_tiles_of<T>(splat, rect, image, mask, tiles);
}
template <class T>
int32_t list_tiles(const RaySplat<T>& splat, TileRect rect, Image image, const T*, uint64_t& mask, int32_t* tiles) {
  return list_tiles_of<T>(splat, rect, image, mask, tiles);
}

#define GS_INSTANTIATE(T)                                                                          \
  template int32_t list_tiles<T>(const Splat<T>&, TileRect, Image, const T*, uint64_t&, int32_t*); \
  template int32_t list_tiles<T>(const RaySplat<T>&, TileRect, Image, const T*, uint64_t&, int32_t*);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
