#pragma once
// The forward of L1 and SSIM on one tile: the work of one thread between two barriers (ssim_tile.h).
#include "cuda/ssim_tile.h"

GS_ISA_BEGIN

struct ForwardTile {
  Four stats[4][kForwardRows][kLanes];  // mean and variance of the sum, then of the difference, down the columns
};

struct Sums {
  float l1, unlike;  // unlike: 1 - SSIM, which keeps its digits where SSIM is near 1
};

// In a tree, so that the sum of equal values is exact and an even image gets no error of one sign.
template <int kCount>
GS_HD float tree_sum(const float (&values)[kCount]) {
  float sums[kCount];
  GS_UNROLL
  for (int i = 0; i < kCount; ++i) sums[i] = values[i];
  GS_UNROLL
  for (int step = 1; step < kCount; step *= 2) {
    GS_UNROLL
    for (int i = 0; i < kCount; i += 2 * step) sums[i] += sums[i + step];
  }
  return sums[0];
}

// The pixels of one column, kRadius rows more than the tile's on either side.
struct Column {
  static constexpr int kCount = kForwardRows + kReach;
  float x1[kCount], delta[kCount];
};

template <class Source>
GS_HD Column load_column(const Tile& tile, const Plane<Source>& plane, int column) {
  float x1[Column::kCount];
  Raw<Source> x2[Column::kCount];
  const int first = tile.row - kRadius;
  const int64_t stride = plane.width;
  const float* from1 = plane.img1 + plane.offset(first, column);
  const Source* from2 = plane.img2 + plane.offset(first, column);
  if (first >= 0 && first + Column::kCount <= plane.height) {
    GS_UNROLL
    for (int i = 0; i < Column::kCount; ++i, from1 += stride, from2 += stride) {
      x1[i] = *from1;
      x2[i] = raw(*from2);
    }
  } else {
    GS_UNROLL
    for (int i = 0; i < Column::kCount; ++i) {
      const bool inside = plane.has_row(first + i);
      x1[i] = inside ? from1[i * stride] : 0;
      x2[i] = inside ? raw(from2[i * stride]) : Raw<Source>(0);
    }
  }
  Column all;
  GS_UNROLL
  for (int i = 0; i < Column::kCount; ++i) {
    const Pixel<float> pixel = plane.pixel(x1[i], x2[i]);
    all.x1[i] = pixel.x1;
    all.delta[i] = pixel.delta;
  }
  return all;
}

// Down the columns; sums |delta| of the tile's own pixels.
template <class Source>
GS_HD void column_stats(ForwardTile& shared, const Tile& tile, const Plane<Source>& plane, int thread, Sums& sums) {
  const int column = thread - kRadius;
  if (!plane.has_column(tile.column + column)) {
    for (auto& stat : shared.stats)
      for (auto& row : stat) at(row, thread) = 0;
    return;
  }
  const Column pixels = load_column(tile, plane, tile.column + column);
  if (column >= 0 && column < kTileColumns) {
    float l1[kForwardRows];
    GS_UNROLL
    for (int i = 0; i < kForwardRows; ++i) l1[i] = std::fabs(pixels.delta[kRadius + i]);
    sums.l1 += tree_sum(l1);
  }
  GS_UNROLL
  for (int row = 0; row < kForwardRows; row += kGroup) {
    const GroupStats<float> stats = stats_of_pixels(pixels.x1 + row, pixels.delta + row);
    GS_UNROLL
    for (int i = 0; i < kGroup; ++i) {
      at(shared.stats[0][row + i], thread) = stats.sum.mean[i];
      at(shared.stats[1][row + i], thread) = stats.sum.var[i];
      at(shared.stats[2][row + i], thread) = stats.difference.mean[i];
      at(shared.stats[3][row + i], thread) = stats.difference.var[i];
    }
  }
}

GS_HD Moments<float> moments_across(const Four* mean, const Four* var, int first) {
  float means[16], vars[16];
  load_row(mean, first, means);
  load_row(var, first, vars);
  return moments_of_moments(means, vars);
}

// The mean pixel of a column's 11 rows, an anchor (ssim_group.h).
GS_HD Pair column_mean(const ForwardTile& shared, int row, int thread) {
  const float difference = at(shared.stats[2][row], thread);
  return {0.5f * (at(shared.stats[0][row], thread) - difference), difference};
}

// Of the image: its width, how far from the border windows begin to count, and what multiplies their derivatives.
struct Frame {
  int width, rim;
  float scale;

  GS_HD bool counts(int at, int size) const { return at >= rim && at < size - rim; }
};

// Across: four windows of each of the thread's rows.
template <bool kGradient>
GS_HD void window_rows(const ForwardTile& shared, const Tile& tile, const Frame& frame, const Maps& maps, int thread,
                       Sums& sums) {
  const int first = thread % kLanes * kGroup, column = tile.column + first;
  if (first >= kTileColumns || column >= frame.width) return;
  const bool all_columns = column >= frame.rim && column + kGroup <= frame.width - frame.rim;
  const int anchor_at = anchor_row(tile.row, maps.height) - tile.row;
  float of_rows = 0;
  for (int row = thread / kLanes; row < kForwardRows && tile.row + row < maps.height; row += kRowsAcross) {
    const GroupStats<float> stats{moments_across(shared.stats[0][row], shared.stats[1][row], first),
                                  moments_across(shared.stats[2][row], shared.stats[3][row], first)};
    const Pixel<float> anchor = column_mean(shared, anchor_at, first + kRadius);
    Unlike<float> windows[kGroup];
    GS_UNROLL
    for (int i = 0; i < kGroup; ++i) windows[i] = unlike(stats, i, anchor, frame.scale);
    const bool row_counts = frame.counts(tile.row + row, maps.height);
    if (!row_counts || !all_columns) {
      GS_UNROLL
      for (int i = 0; i < kGroup; ++i)
        if (!row_counts || !frame.counts(column + i, frame.width)) windows[i] = {};
    }
    const float values[] = {windows[0].unlike, windows[1].unlike, windows[2].unlike, windows[3].unlike};
    of_rows += tree_sum(values);
    if constexpr (kGradient) {
      maps.anchors(tile.plane, tile.across, tile.row + row)[first / kGroup] = column_mean(shared, row, first + kRadius);
      Four* to = reinterpret_cast<Four*>(maps.row(tile.plane, tile.across, tile.row + row) + first);
      to[0] = {windows[0].value, windows[1].value, windows[2].value, windows[3].value};
      to[kMapColumns / 4] = {windows[0].slope1, windows[1].slope1, windows[2].slope1, windows[3].slope1};
      to[kMapColumns / 2] = {windows[0].slope_delta, windows[1].slope_delta, windows[2].slope_delta,
                             windows[3].slope_delta};
    }
  }
  sums.unlike += of_rows;
}

GS_ISA_END
