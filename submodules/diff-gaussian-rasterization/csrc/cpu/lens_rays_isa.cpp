// Gaussians on the rays of a lens: projection and its backward, the tiles that a splat reaches, and the lens's table.
#include "../math/lens_table.h"
#include "project_rows.h"
#include "project_vjp_rows.h"

GS_ISA_BEGIN

namespace {

// Writes the frame of a tile, and the places of its pixels.
template <class T>
void write_frame(const Lens<double>& lens, Image image, int64_t tile, T* out) {
  const int across = tile_count(image.width), left = int(tile % across) * kTile, top = int(tile / across) * kTile;
  TileDirections directions = {};
  for (int p = 0; p < kTile * kTile; ++p) {
    const int x = left + p % kTile, y = top + p / kTile;
    if (x < image.width && y < image.height) directions[p] = direction_of(lens, x, y);
  }
  TileFrame<T> frame = frame_of<T>(directions, lens);
  T* places = const_cast<T*>(places_of<T>(out, image, tile));
  bool any = false;
  for (int p = 0; p < kTile * kTile; ++p) {
    Place<T> place = {T(NAN), T(NAN)};
    if (is_shown(directions[p])) {
      place = place_in(frame, directions[p]);
      frame.x0 = any ? std::min(frame.x0, place.x) : place.x, frame.x1 = any ? std::max(frame.x1, place.x) : place.x;
      frame.y0 = any ? std::min(frame.y0, place.y) : place.y, frame.y1 = any ? std::max(frame.y1, place.y) : place.y;
      any = true;
    }
    places[p] = place.x, places[kTile * kTile + p] = place.y;
  }
  std::memcpy(out + kFrameValues * tile, &frame, sizeof frame);
}

}  // namespace

template <class T>
void lens_table(const Executor& executor, const Lens<double>& lens, Image image, T* out) {
  for_dynamic(executor, tiles_of(image), 4, [&](int64_t begin, int64_t end) {
    for (int64_t tile = begin; tile < end; ++tile) write_frame(lens, image, tile, out);
  });
}

template <class T>
__attribute__((noinline)) int32_t list_tiles(const LensRaySplat<T>& splat, TileRect rect, Image image, const T* table,
                                             uint64_t& mask, int32_t* tiles) {
  using S = Simd<T>;
  using V = typename S::Vec;
  const int wide = rect.x1 - rect.x0, columns = tile_count(image.width), total = wide * (rect.y1 - rect.y0);
  const LensTileTest<T> test = make_tile_test(splat, image, table);
  int32_t count = 0;
  mask = 0;
  for (int done = 0; done < total; done += S::kLanes) {
    Pack<T> pack;
    pack.count = std::min(S::kLanes, total - done);
    for (int i = 0; i < S::kLanes; ++i) {
      const int place = done + (i < pack.count ? i : 0);
      pack.row[i] = (rect.y0 + place / wide) * columns + rect.x0 + place % wide;
    }
    V f[kFrameValues];
    read_rows(table, kFrameValues, tiles_of(image), kFrameValues, pack, f);
    uint32_t reached = S::bits(frame_reached(test, f));
    reached &= (uint64_t(1) << pack.count) - 1;
    if (total <= kMasked) mask |= uint64_t(reached) << done;
    if (tiles)
      for (uint32_t bits = reached; bits; bits &= bits - 1) *tiles++ = pack.row[__builtin_ctz(bits)];
    count += __builtin_popcount(reached);
  }
  return count;
}

template <class T>
void project_on_rays(const Scene<T>& s, const LensRayCamera<T>& camera, const Projected<T>& out) {
  project_block(s, camera, out);
}

template <class T>
void project_vjp_on_rays(const Scene<T>& s, const LensRayCamera<T>& camera, const int32_t* tile_counts,
                         const T* moments, const SceneGradient<T>& out) {
  project_vjp_rows(s, camera, tile_counts, moments, out);
}

#define GS_INSTANTIATE(T)                                                                                  \
  template void lens_table<T>(const Executor&, const Lens<double>&, Image, T*);                            \
  template int32_t list_tiles<T>(const LensRaySplat<T>&, TileRect, Image, const T*, uint64_t&, int32_t*);  \
  template void project_on_rays<T>(const Scene<T>&, const LensRayCamera<T>&, const Projected<T>&);         \
  template void project_vjp_on_rays<T>(const Scene<T>&, const LensRayCamera<T>&, const int32_t*, const T*, \
                                       const SceneGradient<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
