#pragma once
// The gradient of L1 and SSIM on one tile: the work of one thread between two barriers (ssim_tile.h).
#include "cuda/ssim_tile.h"

GS_ISA_BEGIN

// A tile has kRows rows; results do not depend on it. Anchors are every fourth pixel of each row, about which the sums
// down the columns are taken, and those of the blocks of windows that reach the tile.
template <int kRows>
struct BackwardTile {
  static constexpr int kBlocksDown = block_of(kRows + kReach - 1, kBlockRows) + 1, kAnchorRows = kRows + kBlocksDown;
  static constexpr int kBlocksAcross = block_of(kColumns - 1, kGroup) + 1;
  Pair anchors[kAnchorRows][kBlocksAcross];  // of the rows, then of the blocks
  Four sums[3][kRows][kLanes];               // value, slope1 and slope_delta down the columns
};
static_assert(BackwardTile<16>::kBlocksAcross == kLanes + 1);

// The anchors of one column of blocks, the first of which lies kBlockRows columns before the tile's first.
struct AnchorColumn {
  const Pair* first;  // in the plane's first row
  int across, height;
  bool inside;

  GS_HD AnchorColumn(const Tile& tile, const Maps& maps, int width, int across) : across(across), height(maps.height) {
    const int column = tile.column + across * kGroup - kBlockRows;
    inside = column >= 0 && column < width;
    const int strip = inside ? column / kTileColumns : 0;
    first = maps.anchors(tile.plane, strip, 0) + (column - strip * kTileColumns) / kGroup;
  }
  template <int kRows>
  GS_HD void load_row(BackwardTile<kRows>& shared, const Tile& tile, int i) const {
    load(shared.anchors[i][across], tile.row + i);
  }
  template <int kRows>
  GS_HD void load_block(BackwardTile<kRows>& shared, const Tile& tile, int i) const {
    const int begin = tile.row + (i - 1) * kBlockRows;
    load(shared.anchors[kRows + i][across], begin < 0 ? -1 : anchor_row(begin, height));
  }

 private:
  GS_HD void load(Pair& to, int row) const {
    to = inside && row >= 0 && row < height ? first[int64_t(row) * (kMapRow / 2)] : Pair{0, 0};
  }
};

template <int kRows>
GS_HD void load_anchors(BackwardTile<kRows>& shared, const Tile& tile, const Maps& maps, int width, int thread) {
  const AnchorColumn column(tile, maps, width, thread % kLanes);
  const int begin = thread / kLanes;
  GS_UNROLL
  for (int i = 0; i < kRows; i += kRowsAcross) column.load_row(shared, tile, i + begin);
  static_assert(BackwardTile<kRows>::kBlocksDown <= kRowsAcross);
  if (begin < shared.kBlocksDown) column.load_block(shared, tile, begin);
  if (thread >= shared.kAnchorRows) return;
  const AnchorColumn last(tile, maps, width, kLanes);
  if (thread < kRows)
    last.load_row(shared, tile, thread);
  else
    last.load_block(shared, tile, thread - kRows);
}

// The windows of one column, rows from the tile's first less kRadius on.
template <int kRows>
struct WindowColumn {
  float value[kRows + kReach], slope1[kRows + kReach], slope_delta[kRows + kReach];

  // Loads rows [begin, end), with zeros beyond the border. `from` is the column in its first row.
  GS_HD void load(const float* from, int begin, int end, int first_row, int height) {
    if (first_row + begin >= 0 && first_row + end <= height) {
      GS_UNROLL
      for (int i = begin; i < end; ++i) load(i, from + i * kMapRow);
    } else {
      GS_UNROLL
      for (int i = begin; i < end; ++i) {
        value[i] = slope1[i] = slope_delta[i] = 0;
        if (first_row + i >= 0 && first_row + i < height) load(i, from + i * kMapRow);
      }
    }
  }
  GS_HD void load(int i, const float* from) {
    value[i] = from[0];
    slope1[i] = from[kMapColumns];
    slope_delta[i] = from[2 * kMapColumns];
  }
};

GS_HD const float* first_window(const Tile& tile, const Maps& maps, int column) {
  return maps.row(tile.plane, column / kTileColumns, tile.row - kRadius) + column % kTileColumns;
}

// Loads the anchors, and what the first sums down the thread's column need.
template <int kRows>
GS_HD WindowColumn<kRows> load_windows(BackwardTile<kRows>& shared, const Tile& tile, const Maps& maps, int width,
                                       int thread) {
  WindowColumn<kRows> windows;
  const int column = tile.column + thread - kRadius;
  if (column >= 0 && column < width)
    windows.load(first_window(tile, maps, column), 0, kGroupTaps, tile.row - kRadius, maps.height);
  load_anchors(shared, tile, maps, width, thread);
  return windows;
}

// Down the columns. The rows of the next four sums set out before the last of four, when most registers are free.
template <int kRows>
GS_HD void gather_down(BackwardTile<kRows>& shared, const Tile& tile, const Maps& maps, int width,
                       WindowColumn<kRows>& windows, int thread) {
  const int column = tile.column + thread - kRadius, across = block_of(thread, kGroup);
  if (column < 0 || column >= width) {
    for (auto& sums : shared.sums)
      for (auto& row : sums) at(row, thread) = 0;
    return;
  }
  const float* from = first_window(tile, maps, column);
  const auto anchor = [&](int i) { return Pixel<float>(shared.anchors[kRows + i][across]); };
  GS_UNROLL
  for (int row = 0; row < kRows; ++row) {
    if (const int next = row + kReach + 1; next % kGroup == kGroupTaps % kGroup && next < kRows + kReach)
      windows.load(from, next, next + kGroup, tile.row - kRadius, maps.height);
    const Gathered<float> sum = gather_about<kBlockRows, float>(shared.anchors[row][across], row, windows.value,
                                                                windows.slope1, windows.slope_delta, anchor);
    at(shared.sums[0][row], thread) = sum.value;
    at(shared.sums[1][row], thread) = sum.slope1;
    at(shared.sums[2][row], thread) = sum.slope_delta;
  }
}

// What becomes of the gradient of SSIM at a pixel.
struct Chain {
  float by_l1, by_ssim;
  float* gradient;  // of the plane
  bool quads;       // four neighbours of a row lie at a multiple of their size, in both images and in the gradient
};

template <class T>
GS_HD Quad<T> load_quad(const T* from, int count, bool whole) {
  if (whole) return *reinterpret_cast<const Quad<T>*>(from);
  Quad<T> quad{};
  GS_UNROLL
  for (int i = 0; i < 4; ++i)
    if (i < count) quad.of[i] = from[i];
  return quad;
}

// Across: four pixels of each of the thread's rows.
template <int kRows, class Source>
GS_HD void gather_across(const BackwardTile<kRows>& shared, const Tile& tile, const Plane<Source>& plane,
                         const Chain& chain, int thread) {
  const int first = thread % kLanes * kGroup, column = tile.column + first, count = plane.width - column;
  if (first >= kTileColumns || count <= 0) return;
  const int first_row = thread / kLanes;
  const int end = plane.height - tile.row < kRows ? plane.height - tile.row : kRows;
  int64_t at = plane.offset(tile.row + first_row, column);
  for (int row = first_row; row < end; row += kRowsAcross, at += int64_t(kRowsAcross) * plane.width) {
    const Quad<float> x1 = load_quad(plane.img1 + at, count, chain.quads);
    const Quad<Source> x2 = load_quad(plane.img2 + at, count, chain.quads);
    float value[16], slope1[16], slope_delta[16];
    load_row(shared.sums[0][row], first, value);
    load_row(shared.sums[1][row], first, slope1);
    load_row(shared.sums[2][row], first, slope_delta);
    const auto anchor = [&](int i) { return Pixel<float>(shared.anchors[row][first / kGroup + i]); };
    Four gradient;
    GS_UNROLL
    for (int i = 0; i < kGroup; ++i) {
      const Pixel<float> pixel = plane.pixel(x1.of[i], raw(x2.of[i]));
      const float by_x1 = gather_about<kGroup>(pixel, i, value, slope1, slope_delta, anchor).value;
      const float l1 = chain.by_l1 * abs_difference_vjp(0.0f, pixel.delta);
      const bool counts = int(in_unit(x1.of[i])) | int(!plane.clamp);  // without a branch
      gradient.of[i] = counts ? chain.by_ssim * by_x1 + l1 : 0;
    }
    float* to = chain.gradient + at;
    if (chain.quads) {
      *reinterpret_cast<Four*>(to) = gradient;
    } else {
      GS_UNROLL
      for (int i = 0; i < kGroup; ++i)
        if (i < count) to[i] = gradient.of[i];
    }
  }
}

GS_ISA_END
