#pragma once
// A block's walk down a strip of an image, kStep rows a step: the work of one thread between two barriers. This
// includes no CUDA runtime, so that csrc/tests runs the same lines on the host.
//
// A strip has 128 columns of inputs and of their statistics (downwards), 118 of windows and 108 of gradients, each
// counted from the strip's first. A window takes five columns on either side. Rows likewise: window m takes inputs m to
// m + 10, and gradient o takes windows o to o + 10 and lies at input o + 10. Step s has
//   inputs    s kStep ...  s kStep + kStep + 9      (a ring, of which kStep rows are new)
//   windows   s kStep ...  s kStep + kStep - 1      (into a ring that keeps ten earlier rows)
//   gradients s kStep - 10 ...  s kStep + kStep - 11
// A thread takes kPerThread neighbours along the direction of its sum, so that 11 taps cost 3.5 loads a pixel.
#include <cmath>
#include <cstdint>
#include <initializer_list>

#include "math/ssim.h"

#ifdef __CUDACC__
#define GS_UNROLL _Pragma("unroll")
#else
#define GS_UNROLL
#endif

GS_ISA_BEGIN

constexpr int kReach = 2 * kRadius;
constexpr int kPerThread = 4;
constexpr int kTaps = kPerThread + kReach;  // inputs that kPerThread neighbours read of a row or column
constexpr int kStep = 4;
constexpr int kColumns = 128, kMapColumns = kColumns - kReach, kOutColumns = kMapColumns - kReach;
constexpr int kThreads = kColumns * kStep / kPerThread;
constexpr int kLanes = kThreads / kStep;  // threads to a row when a thread takes neighbours along it
constexpr int kRing = kStep + kReach;
static_assert(kPerThread == 4 && kOutColumns % 4 == 0 && kMapColumns <= kPerThread * kLanes);

GS_HD constexpr int fours(int n) { return (n + 3) / 4; }

// 16 bytes a load or store.
struct alignas(16) Four {
  float of[4];
};
GS_HD float& at(Four* row, unsigned column) { return row[column / 4].of[column % 4]; }
GS_HD float at(const Four* row, unsigned column) { return row[column / 4].of[column % 4]; }

// The shared memory of a block. `stats` has the windows' mu1, mu_delta, var1, var_delta and cov. `maps` has value,
// slope1, slope_delta, anchor.x1 and anchor.delta; gathered down the columns, those take the place of `stats`.
struct Strip {
  Four stats[5][kStep][fours(kColumns) + 1];  // one more: the last lane reads past the end, where values do not count
  Four maps[5][kRing][fours(kMapColumns)];
  Four gradient[kStep][fours(kOutColumns)];
  float x1[kRing][kColumns], delta[kRing][kColumns];
};

// The part of the plane that a block computes.
struct Part {
  int64_t height, width;  // of the plane
  int64_t row, column;    // the first pixel
  int rows;               // and at most kOutColumns columns; the reader cuts both at the plane's edge
  int rim;                // windows this near to the edge do not count
};

struct Sums {
  double l1, ssim;
};

// Place in the ring of the row `after` rows past the one at `begin`; after < kRing.
GS_HD int slot(int begin, int after) { return begin + after < kRing ? begin + after : begin + after - kRing; }

GS_HD float to_float(float v) { return v; }
GS_HD float to_float(uint8_t v) { return float(v) / 255.0f; }

// A thread's pixels, kPerThread of one column, of the input rows from `first` on.
struct Rows {
  float x1[kPerThread], delta[kPerThread];
};
constexpr int kRowsApart = kThreads / kColumns;

template <class Source>
GS_HD Rows load(const Part& part, const float* img1, const Source* img2, bool clamp, int first, int thread) {
  Rows rows;
  const int64_t column = part.column - kReach + thread % kColumns;
  GS_UNROLL
  for (int i = 0; i < kPerThread; ++i) {
    const int64_t row = part.row - kReach + first + thread / kColumns + i * kRowsApart;
    const bool inside = row >= 0 && row < part.height && column >= 0 && column < part.width;
    const int64_t at = inside ? row * part.width + column : 0;
    const float x1 = inside ? img1[at] : 0;
    rows.x1[i] = clamp ? clamp_to_unit(x1) : x1;
    rows.delta[i] = inside ? to_float(img2[at]) - rows.x1[i] : 0;
  }
  return rows;
}

// Stores the rows before `end`, and sums |delta| over the block's own pixels.
GS_HD void put(Strip& strip, const Part& part, const Rows& rows, int first, int end, int thread, Sums& sums) {
  const int column = thread % kColumns;
  const bool own_column = column >= kReach && column < kReach + kOutColumns;
  GS_UNROLL
  for (int i = 0; i < kPerThread; ++i) {
    const int row = first + thread / kColumns + i * kRowsApart;
    if (row >= end) break;
    strip.x1[row % kRing][column] = rows.x1[i];
    strip.delta[row % kRing][column] = rows.delta[i];
    if (own_column && row >= kReach && row < kReach + part.rows) sums.l1 += std::fabs(rows.delta[i]);
  }
}

GS_HD void column_stats(Strip& strip, int step, int thread) {
  const int column = thread % kColumns, row = thread / kColumns * kPerThread;
  const int begin = (step * kStep) % kRing;
  Pixel<float> pixels[kTaps];
  GS_UNROLL
  for (int i = 0; i < kTaps; ++i) {
    const int j = slot(begin, row + i);
    pixels[i] = {strip.x1[j][column], strip.delta[j][column]};
  }
  GS_UNROLL
  for (int i = 0; i < kPerThread; ++i) {
    const auto stats = stats_of_values<float, float>([&](int k) { return pixels[i + kRadius + k]; });
    at(strip.stats[0][row + i], column) = stats.mu1;
    at(strip.stats[1][row + i], column) = stats.mu_delta;
    at(strip.stats[2][row + i], column) = stats.var1;
    at(strip.stats[3][row + i], column) = stats.var_delta;
    at(strip.stats[4][row + i], column) = stats.cov;
  }
}

// Five quantities of kTaps neighbours in a row, and of up to three more.
struct Neighbours {
  Four of[5][fours(kTaps)];
  GS_HD float operator()(int quantity, int i) const { return of[quantity][i / 4].of[i % 4]; }
};

GS_HD Neighbours load_neighbours(const Strip& strip, int row, int first) {
  Neighbours n;
  GS_UNROLL
  for (int quantity = 0; quantity < 5; ++quantity) {
    GS_UNROLL
    for (int i = 0; i < fours(kTaps); ++i) n.of[quantity][i] = strip.stats[quantity][row][first / 4 + i];
  }
  return n;
}

// Computes SSIM of a row's windows, and what its gradient needs.
template <bool kGradient>
GS_HD void window_row(Strip& strip, const Part& part, int step, int thread, Sums& sums) {
  const int row = thread / kLanes, first = thread % kLanes * kPerThread;
  if (first >= kMapColumns) return;
  const int64_t image_row = part.row - kRadius + step * kStep + row;
  const int own_row = step * kStep + row - kRadius;
  const bool row_counts = image_row >= part.rim && image_row < part.height - part.rim;
  const bool row_is_own = own_row >= 0 && own_row < part.rows;
  const Neighbours n = load_neighbours(strip, row, first);
  Four maps[5];
  GS_UNROLL
  for (int i = 0; i < kPerThread; ++i) {
    const auto result = ssim<float>(stats_of_stats<float, float>([&](int k) {
      const int j = i + kRadius + k;
      return Stats<float>{n(0, j), n(1, j), n(2, j), n(3, j), n(4, j)};
    }));
    const int column = first + i;
    const int64_t image_column = part.column - kRadius + column;
    const bool counts = row_counts && image_column >= part.rim && image_column < part.width - part.rim;
    if (counts && row_is_own && column >= kRadius && column < kRadius + kOutColumns) sums.ssim += result.value;
    maps[0].of[i] = counts ? result.by_pixel.value : 0;
    maps[1].of[i] = counts ? result.by_pixel.slope1 : 0;
    maps[2].of[i] = counts ? result.by_pixel.slope_delta : 0;
    maps[3].of[i] = result.by_pixel.anchor.x1;
    maps[4].of[i] = result.by_pixel.anchor.delta;
  }
  if constexpr (kGradient) {
    GS_UNROLL
    for (int quantity = 0; quantity < 5; ++quantity)
      strip.maps[quantity][slot(step * kStep % kRing, row)][first / 4] = maps[quantity];
  }
}

GS_HD void gather_down(Strip& strip, int step, int thread) {
  const int column = thread % kColumns, row = thread / kColumns * kPerThread;
  if (column >= kMapColumns) return;
  const int begin = (step * kStep + kStep) % kRing;  // the oldest row, ten before this step's first
  const int pixels = step * kStep % kRing;
  Anchored<float> maps[kTaps];
  GS_UNROLL
  for (int i = 0; i < kTaps; ++i)
    maps[i] = {at(strip.maps[0][slot(begin, row + i)], column),
               at(strip.maps[1][slot(begin, row + i)], column),
               at(strip.maps[2][slot(begin, row + i)], column),
               {at(strip.maps[3][slot(begin, row + i)], column), at(strip.maps[4][slot(begin, row + i)], column)}};
  GS_UNROLL
  for (int i = 0; i < kPerThread; ++i) {
    const int j = slot(pixels, row + i);
    const Pixel<float> pixel{strip.x1[j][column + kRadius], strip.delta[j][column + kRadius]};
    const auto sum = gather<float>([&](int k) { return maps[i + kRadius + k]; }, pixel);
    at(strip.stats[0][row + i], column) = sum.value;
    at(strip.stats[1][row + i], column) = sum.slope1;
    at(strip.stats[2][row + i], column) = sum.slope_delta;
    at(strip.stats[3][row + i], column) = pixel.x1;
    at(strip.stats[4][row + i], column) = pixel.delta;
  }
}

GS_HD void gather_across(Strip& strip, int thread) {
  const int row = thread / kLanes, first = thread % kLanes * kPerThread;
  if (first >= kOutColumns) return;
  const Neighbours n = load_neighbours(strip, row, first);
  Four gradient;
  GS_UNROLL
  for (int i = 0; i < kPerThread; ++i) {
    const auto of_column = [&](int k) {
      const int j = i + kRadius + k;
      return Anchored<float>{n(0, j), n(1, j), n(2, j), {n(3, j), n(4, j)}};
    };
    gradient.of[i] = gather<float>(of_column, of_column(0).anchor).value;
  }
  strip.gradient[row][first / 4] = gradient;
}

// Writes the step's gradients, through shared memory so that neighbouring threads write neighbouring pixels.
GS_HD void write_gradient(const Strip& strip, const Part& part, int step, float scale, float* plane, int thread) {
  const int column = thread % kColumns;
  if (column >= kOutColumns || part.column + column >= part.width) return;
  GS_UNROLL
  for (int i = 0; i < kPerThread; ++i) {
    const int row = thread / kColumns + i * kRowsApart, own_row = step * kStep - kReach + row;
    if (own_row >= 0 && own_row < part.rows)
      plane[(part.row + own_row) * part.width + part.column + column] = scale * at(strip.gradient[row], column);
  }
}

GS_HD int step_count(int rows) { return (rows + kReach + kStep - 1) / kStep; }

// The cut of the planes into parts. It depends on their size alone, so that an image has the same sum on every GPU.
struct Cut {
  int rows;               // of a part, at most
  int64_t across, parts;  // parts side by side, and all

  static Cut with_steps(int steps, int64_t planes, int64_t height, int64_t width) {
    Cut cut{};
    cut.rows = steps * kStep - kReach;
    cut.across = (width + kOutColumns - 1) / kOutColumns;
    cut.parts = planes * cut.across * cut.down(height);
    return cut;
  }

  static Cut of(int64_t planes, int64_t height, int64_t width) {
    constexpr int64_t kEnough =
        512;  // blocks that fill a large GPU; longer parts repeat less of their neighbours' work
    for (const int steps : {20, 12}) {
      const Cut cut = with_steps(steps, planes, height, width);
      if (cut.parts >= kEnough) return cut;
    }
    return with_steps(8, planes, height, width);
  }

  GS_HD int64_t down(int64_t height) const { return (height + rows - 1) / rows; }
};

GS_HD Part part_of(const Cut& cut, int64_t height, int64_t width, bool valid, int64_t i) {
  Part part{};
  part.height = height;
  part.width = width;
  part.row = i / cut.across % cut.down(height) * cut.rows;
  part.column = i % cut.across * kOutColumns;
  part.rows = height - part.row < cut.rows ? int(height - part.row) : cut.rows;
  part.rim = valid ? kRadius : 0;
  return part;
}

GS_ISA_END
