#pragma once
// The directions that a lens's pixels see, as a table has them (lens_pixels.h). All is computed in double.
#include "lens.h"
#include "lens_pixels.h"

GS_ISA_BEGIN

using Direction = Vec3<double>;

// The direction, of length 1, that a pixel sees; 0 where the lens shows nothing. Newton's method, from the pixel's
// numbers as if there were no distortion: it needs few steps but where the distortion nearly turns back.
GS_HD Direction direction_of(const Lens<double>& lens, double x, double y) {
  const double a0 = (x - lens.center_x) / lens.focal_x, b0 = (y - lens.center_y) / lens.focal_y;
  double a = a0, b = b0, off = INFINITY;
  constexpr int kSteps = 60;
  for (int step = 0; step < kSteps; ++step) {
    const Distorted<double> d = distort(lens, a, b);
    const double (&j)[2][2] = d.first;
    const double u = d.value[0] - a0, v = d.value[1] - b0;
    off = std::fmax(std::fabs(u), std::fabs(v));
    if (!(off > 1e-15)) break;
    const double det = j[0][0] * j[1][1] - j[0][1] * j[1][0];
    a -= (j[1][1] * u - j[0][1] * v) / det, b -= (j[0][0] * v - j[1][0] * u) / det;
  }
  constexpr double kSolved = 1e-9;  // of the chart's numbers
  if (!(off < kSolved) || a * a + b * b > lens.limit) return {};
  if (lens.chart == Chart::kPerspective) {
    const double length = std::sqrt(a * a + b * b + 1);
    return {a / length, b / length, 1 / length};
  }
  if (lens.chart == Chart::kEquidistant) {
    const double theta = std::sqrt(a * a + b * b), stretch = theta > 0 ? std::sin(theta) / theta : 1;
    return theta < kPi ? Direction{a * stretch, b * stretch, std::cos(theta)} : Direction{};
  }
  if (std::fabs(a) > kPi || std::fabs(b) > kPi / 2) return {};
  return {std::sin(a) * std::cos(b), std::sin(b), std::cos(a) * std::cos(b)};
}

GS_HD bool is_shown(Direction d) { return dot(d, d) > 0; }

// The directions of a tile's pixels, row by row; 0 where the lens or the image shows none.
using TileDirections = Direction[kTile * kTile];

// The pixel that is shown next to the middle of all that are, or any if none is.
GS_HD int middle_of(const TileDirections& d) {
  constexpr int kMiddle = kTile / 2 * (kTile + 1), kPixels = kTile * kTile;
  int count = 0, across = 0, down = 0, found = kMiddle, least = 2 * kPixels * kPixels;
  for (int p = 0; p < kPixels; ++p)
    if (is_shown(d[p])) ++count, across += p % kTile, down += p / kTile;
  if (count == kPixels) return kMiddle;
  for (int p = 0; p < kPixels; ++p) {
    const int x = count * (p % kTile) - across, y = count * (p / kTile) - down, square = (x * x + y * y) / kPixels;
    if (is_shown(d[p]) && square < least) found = p, least = square;
  }
  return found;
}

// The frame of a tile, without its limits.
template <class T>
GS_HD TileFrame<T> frame_of(const TileDirections& d, const Lens<double>& lens) {
  const int at = middle_of(d);
  const Direction middle = d[at];
  const bool upright = std::fabs(middle.y) < 0.5;
  const Direction side = cross(upright ? Direction{0, 1, 0} : Direction{1, 0, 0}, middle);
  Direction across = (1 / lens.focal_x) * side, down = (1 / lens.focal_y) * cross(middle, side);
  const int column = at % kTile, row = at / kTile;
  if (column > 0 && column < kTile - 1 && row > 0 && row < kTile - 1 && is_shown(d[at - 1]) && is_shown(d[at + 1]) &&
      is_shown(d[at - kTile]) && is_shown(d[at + kTile]))
    across = 0.5 * (d[at + 1] - d[at - 1]), down = 0.5 * (d[at + kTile] - d[at - kTile]);
  const auto rounded = [](Direction v) { return Vec3<T>{T(v.x), T(v.y), T(v.z)}; };
  return {rounded(middle), rounded(across), rounded(down), 1, -1, 1, -1, {}};
}

// The place of a direction in a frame.
template <class T>
GS_HD Place<T> place_in(const TileFrame<T>& frame, Direction d) {
  const auto wide = [](Vec3<T> v) { return Direction{v.x, v.y, v.z}; };
  const Direction at = wide(frame.at), across = wide(frame.across), down = wide(frame.down);
  const double depth = dot(d, cross(across, down));
  return {T(dot(d, cross(down, at)) / depth), T(dot(d, cross(at, across)) / depth)};
}

GS_ISA_END
