#pragma once
// The tiles that a splat reaches: those where its alpha is at least 1/255 at some pixel centre.
#include <cstdint>

#include "../data.h"
#include "constants.h"
#include "splat.h"
#include "vec.h"

GS_ISA_BEGIN

// Tiles x0 <= x < x1, y0 <= y < y1.
template <class I>
struct Rect {
  I x0, y0, x1, y1;
};
using TileRect = Rect<int32_t>;

GS_HD int tile_count(int pixels) { return (pixels + kTile - 1) / kTile; }
GS_HD int64_t tiles_of(Image image) { return int64_t(tile_count(image.width)) * tile_count(image.height); }

// Whether a TileRecord can hold the rectangles of an image.
GS_HD bool has_records(Image image) {
  constexpr int kMostTiles = 0xffff;
  return tile_count(image.width) <= kMostTiles && tile_count(image.height) <= kMostTiles;
}

template <class T>
GS_HD Integer<T> clamped_floor(T value, int limit) {
  const T below = value < Scalar<T>(limit) ? value : all<T>(limit);
  return integer(value > 0 ? below : T{});
}

// Tells whether the square of 3-sigma radius meets the image: the reference's rule for `radii`, by whole tiles.
template <class T>
GS_HD Truth<T> radius_on_image(T x, T y, Integer<T> radius, int width, int height) {
  const T r = number<T>(radius);
  const Scalar<T> tile = Scalar<T>(kTile);
  const int nx = tile_count(width), ny = tile_count(height);
  return (clamped_floor((x + r + tile - 1) / tile, nx) > clamped_floor((x - r) / tile, nx)) &
         (clamped_floor((y + r + tile - 1) / tile, ny) > clamped_floor((y - r) / tile, ny));
}

// The box of tiles with pixels from x0 to x1 and y0 to y1, px, if `some`.
template <class T>
GS_HD Rect<Integer<T>> tiles_between(Truth<T> some, T x0, T x1, T y0, T y1, int width, int height) {
  using Number = Scalar<T>;
  const Integer<T> none = {};
  some &= (x1 >= 0) & (y1 >= 0) & (x0 <= Number(width - 1)) & (y0 <= Number(height - 1));
  if (!any(some)) return {none, none, none, none};
  const Number tile = Number(kTile);
  const int nx = tile_count(width), ny = tile_count(height);
  return {some ? clamped_floor<T>(x0 / tile, nx - 1) : none, some ? clamped_floor<T>(y0 / tile, ny - 1) : none,
          some ? clamped_floor<T>(x1 / tile, nx - 1) + 1 : none, some ? clamped_floor<T>(y1 / tile, ny - 1) + 1 : none};
}

// The box of tiles that the splat can reach. |dx| is at most sqrt(reach) / |column of L^-1|, with
// L^-1 = (1/l11, -l12/(l11 l22); 0, 1/l22). around: of a full panorama. A splat that crosses its border is marked, and
// gets whole rows of tiles, which are then tested one by one: few splats do.
template <class T>
GS_HD Rect<Integer<T>> tile_rect(Splat<T>& s, int width, int height, bool around) {
  using Number = Scalar<T>;
  const T level = s.log2_opacity - Number(kLog2MinAlpha);
  const Integer<T> none = {};
  const Truth<T> some = level > Number(-1e-3);
  if (!any(some)) return {none, none, none, none};
  const T reach = root(larger(level, T{})) * Number(1.0001) + Number(0.01);
  const T dx = reach * length<T>(all<T>(1), s.l12 / s.l22) / s.l11 + Number(0.01), dy = reach / s.l22 + Number(0.01);
  Rect<Integer<T>> rect = tiles_between<T>(some, s.x - dx, s.x + dx, s.y - dy, s.y + dy, width, height);
  if (around) {
    // Not so wide either that a tile of its rectangle may be nearer to another copy.
    const Truth<T> wide = dx > Number(width) / 2 - Number(kTile);
    const Truth<T> crosses = (rect.x1 > rect.x0) & (wide | (s.x - dx < 0) | (s.x + dx > Number(width - 1)));
    rect.x0 = crosses ? none : rect.x0, rect.x1 = crosses ? none + tile_count(width) : rect.x1;
    s.l11 = crosses ? -s.l11 : s.l11;
  }
  return rect;
}

// The part of one splat's tile tests that does not depend on the tile. l11 is not 0 and l22 above it, because
// projection culls other splats.
template <class T>
struct TileTest {
  Splat<T> splat;
  T last_x, last_y;  // of the image's pixels
  T slope_x;         // dx at which u^2 is least for a given dy, per dy
  T slope_y;         // dy at which u^2 + v^2 is least for a given dx, per dx
  T level;           // u^2 + v^2 up to which a pixel is reached, rounding margin included
};

// The margin, in log2 units: u and v are sums of products with a relative error of some units in the last place of
// their terms, and (u, v) stays below 2.83 where it matters. A design study without a margin dropped 1,678 of 478,183
// borderline tiles wrongly. With it, leaving tiles out changes no bit of the image; the tests check this.
template <class T>
GS_HD TileTest<T> make_tile_test(const Splat<T>& s, TileRect rect, int width, int height) {
  const T unit = sizeof(T) == 4 ? T(5.9604644775390625e-8) : T(1.1102230246251565e-16);
  const T l11 = magnitude(s.l11);
  const T far_x = larger(magnitude(T(rect.x0 * kTile) - s.x), magnitude(T(rect.x1 * kTile) - s.x));
  const T far_y = larger(magnitude(T(rect.y0 * kTile) - s.y), magnitude(T(rect.y1 * kTile) - s.y));
  const T terms = multiply_add(l11, far_x, multiply_add(magnitude(s.l12), far_y, T(2)));
  return {s,
          T(width - 1),
          T(height - 1),
          -s.l12 / l11,
          -l11 * s.l12 / multiply_add(s.l12, s.l12, s.l22 * s.l22),
          multiply_add(48 * unit, terms, s.log2_opacity - T(kLog2MinAlpha))};
}

// Compares the least u^2 + v^2 over the box of pixel centres x0..x1, y0..y1 (px, inclusive). It is 0 if the mean is
// inside; else it lies on an edge that faces the mean, where it is a parabola in one coordinate. The box has points
// between the centres too, so this may keep a tile that no pixel needs, but never drops one that a pixel needs. V is T
// or a vector of boxes. Products are arranged so that a compiler can fuse them in one way only, because counting must
// agree with emission.
template <class T, class V, class Level>
GS_HD auto box_reached(const TileTest<T>& test, Level level, V left, V right, V top, V bottom) {
  const Splat<T>& s = test.splat;
  const V x0 = left - s.x, x1 = right - s.x, y0 = top - s.y, y1 = bottom - s.y;
  const auto within = [&](V dx, V dy) {
    const V u = s.l11 * (dx - test.slope_x * dy), v = s.l22 * dy;
    return u * u <= level - v * v;
  };
  const auto beside = (x0 > T(0)) | (x1 < T(0)), above = (y0 > T(0)) | (y1 < T(0));
  const V dx = x0 > T(0) ? x0 : x1, dy = y0 > T(0) ? y0 : y1;
  const auto side = within(dx, clamp(V(test.slope_y * dx), y0, y1));
  const auto edge = within(clamp(V(test.slope_x * dy), x0, x1), dy);
  const auto outside = beside | above;
  return (beside & side) | (above & edge) | ((!outside) & (V{} + level >= T(0)));
}

template <class T, class V>
GS_HD auto box_reached(const TileTest<T>& test, V left, V right, V top, V bottom) {
  return box_reached(test, test.level, left, right, top, bottom);
}

// Tests tiles given by column and row; V as above. Test: TileTest, or RayTileTest. kMayCross: whether the splat may
// cross a panorama's border.
template <bool kMayCross = true, class Test, class V, class T = Scalar<V>>
GS_HD auto tile_reached(const Test& test, V tile_x, V tile_y) {
  V left = tile_x * T(kTile), right = left + T(kTile - 1), top = tile_y * T(kTile), bottom = top + T(kTile - 1);
  const V last_x = V{} + test.last_x, last_y = V{} + test.last_y;
  right = right < last_x ? right : last_x, bottom = bottom < last_y ? bottom : last_y;
  if constexpr (kMayCross) {
    const V there = unrolled(test.splat, left, int(test.last_x) + 1);
    right += there - left, left = there;
  }
  return box_reached(test, left, right, top, bottom);
}

GS_ISA_END
