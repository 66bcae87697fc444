// L1 and SSIM with the gradient of SSIM, in one walk over tiles that stay in the L2 cache. The tiles depend on the
// image's size alone and their sums are added in order, so the number of threads changes no bit.
#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "backend.h"
#include "gs/simd.h"
#include "math/ssim.h"

GS_ISA_BEGIN
namespace {

constexpr int64_t kReach = 2 * kRadius;  // rows or columns that a window needs beside its first one
constexpr int64_t kTileRows = 32;        // the statistics of kReach more rows are computed twice: 31 % of them

constexpr int64_t round_up(int64_t n, int64_t to) { return (n + to - 1) / to * to; }

struct Range {
  int64_t begin, end;
  int64_t size() const { return end - begin; }
};

// The number of parts of [0, n) if none is longer than `longest`, and part i of them; their sizes differ by one at
// most.
int64_t parts(int64_t n, int64_t longest) { return (n + longest - 1) / longest; }
Range part(int64_t n, int64_t count, int64_t i) { return {n * i / count, n * (i + 1) / count}; }

// The working memory of a tile. Its inputs reach two windows beyond the tile, its maps one.
template <class T>
struct Scratch {
  static constexpr int64_t kColumns = kRowPart<T>;
  static constexpr int64_t kStride = kColumns + 2 * round_up(kReach, Simd<T>::kLanes);
  T x1[kTileRows + 2 * kReach][kStride], delta[kTileRows + 2 * kReach][kStride];
  T mu1[kStride], mu_delta[kStride], var1[kStride], var_delta[kStride], cov[kStride];  // of one row of columns
  T row[kStride];  // SSIM, |delta| or gradient of one row of the tile
  struct Maps {    // Anchored, of each pixel of one row
    T value[kStride], slope1[kStride], slope_delta[kStride], anchor1[kStride], anchor_delta[kStride];
  } maps[kTileRows + kReach];
  T value[kStride], slope1[kStride], slope_delta[kStride];  // of one row, gathered down its columns
};

template <class T>
T to_value(T v) {
  return v;
}
template <class T>
T to_value(uint8_t v) {
  return T(v) / T(255);
}

// Loads columns [begin, begin + width) of a row of the images, and zeros outside them. A row above or below is null.
template <class T, class Source>
void load_row(const T* img1, const Source* img2, bool clamp, int64_t columns, int64_t begin, int64_t width, T* x1,
              T* delta) {
  const int64_t first = std::min(std::max<int64_t>(-begin, 0), width);
  const int64_t last = img1 ? std::max(std::min(columns - begin, width), first) : first;
  for (int64_t i = first; i < last; ++i) {
    x1[i] = clamp ? clamp_to_unit(img1[begin + i]) : img1[begin + i];
    delta[i] = to_value<T>(img2[begin + i]) - x1[i];
  }
  for (T* row : {x1, delta}) {
    std::fill(row, row + first, T(0));
    std::fill(row + last, row + width, T(0));
  }
}

// Sum in double over eight interleaved lanes: the same tree for every instruction set.
template <class T>
double row_sum(const T* values, int64_t n) {
  double lanes[8] = {};
  int64_t i = 0;
  for (; i + 8 <= n; i += 8)
    for (int j = 0; j < 8; ++j) lanes[j] += values[i + j];
  for (int j = 0; i + j < n; ++j) lanes[j] += values[i + j];
  for (int half = 4; half > 0; half /= 2)
    for (int j = 0; j < half; ++j) lanes[j] += lanes[j + half];
  return lanes[0];
}

// Computes the statistics down the columns of one row of windows, whose topmost row is `top`.
template <class T>
void column_stats(Scratch<T>& s, int64_t top, int64_t width) {
  using V = Simd<T>;
  using Vec = typename V::Vec;
  for (int64_t j = 0; j < width; j += V::kLanes) {
    const T *x1 = &s.x1[top + kRadius][j], *delta = &s.delta[top + kRadius][j];
    const Stats<Vec> stats = stats_of_values<T, Vec>([&](int k) {
      return Pixel<Vec>{V::load(x1 + k * Scratch<T>::kStride), V::load(delta + k * Scratch<T>::kStride)};
    });
    V::store(s.mu1 + j, stats.mu1);
    V::store(s.mu_delta + j, stats.mu_delta);
    V::store(s.var1 + j, stats.var1);
    V::store(s.var_delta + j, stats.var_delta);
    V::store(s.cov + j, stats.cov);
  }
}

// Computes SSIM of one row of pixels from its columns' statistics and, if maps are given, what the gradient needs.
template <class T>
void ssim_row(Scratch<T>& s, int64_t width, typename Scratch<T>::Maps* maps) {
  using V = Simd<T>;
  using Vec = typename V::Vec;
  for (int64_t j = 0; j < width; j += V::kLanes) {
    const Ssim<Vec> result = ssim<T>(stats_of_stats<T, Vec>([&](int k) {
      const int64_t at = j + kRadius + k;
      return Stats<Vec>{V::load(s.mu1 + at), V::load(s.mu_delta + at), V::load(s.var1 + at), V::load(s.var_delta + at),
                        V::load(s.cov + at)};
    }));
    V::store(s.row + j, result.value);
    if (!maps) continue;
    V::store(maps->value + j, result.by_pixel.value);
    V::store(maps->slope1 + j, result.by_pixel.slope1);
    V::store(maps->slope_delta + j, result.by_pixel.slope_delta);
    V::store(maps->anchor1 + j, result.by_pixel.anchor.x1);
    V::store(maps->anchor_delta + j, result.by_pixel.anchor.delta);
  }
}

// Computes the gradient of the sum of SSIM at a row of the tile, down the columns and then across.
template <class T>
void gradient_row(Scratch<T>& s, int64_t row, int64_t width) {
  using V = Simd<T>;
  using Vec = typename V::Vec;
  const auto pixel = [x1 = s.x1[row + kReach], delta = s.delta[row + kReach]](int64_t j) {
    return Pixel<Vec>{V::load(x1 + j), V::load(delta + j)};
  };
  const auto* maps = &s.maps[row + kRadius];
  for (int64_t j = 0; j < width + kReach; j += V::kLanes) {
    const auto sum = gather<T>(
        [&](int k) {
          const auto& m = maps[k];
          return Anchored<Vec>{V::load(m.value + j),
                               V::load(m.slope1 + j),
                               V::load(m.slope_delta + j),
                               {V::load(m.anchor1 + j), V::load(m.anchor_delta + j)}};
        },
        pixel(j + kRadius));
    V::store(s.value + j, sum.value);
    V::store(s.slope1 + j, sum.slope1);
    V::store(s.slope_delta + j, sum.slope_delta);
  }
  for (int64_t j = 0; j < width; j += V::kLanes) {
    const auto sum = gather<T>(
        [&](int k) {
          const int64_t at = j + kRadius + k;
          return Anchored<Vec>{V::load(s.value + at), V::load(s.slope1 + at), V::load(s.slope_delta + at),
                               pixel(at + kRadius)};
        },
        pixel(j + kReach));
    V::store(s.row + j, sum.value);
  }
}

struct Sums {
  double l1, ssim;
};

// sums: of the first row of the tile in its columns; those of the next row come `across` later.
template <class T, class Source>
void tile(const L1Ssim<T>& args, int64_t plane, Range rows, Range columns, double gradient_scale, Scratch<T>& s,
          Sums* sums, int64_t across) {
  const auto& image = args.images;
  const int64_t height = image.height, width = image.width;
  const T* img1 = image.img1 + plane * height * width;
  const Source* img2 = static_cast<const Source*>(image.img2) + plane * height * width;
  const int64_t margin = args.gradient ? kRadius : 0;  // SSIM is needed this far around the tile
  const int64_t rim = args.valid ? kRadius : 0;
  const int64_t lanes = Simd<T>::kLanes;
  const int64_t map_columns =
      args.gradient ? round_up(round_up(columns.size(), lanes) + kReach, lanes) : round_up(columns.size(), lanes);
  const int64_t input_columns = round_up(map_columns + kReach, lanes);

  const int64_t first_row = rows.begin - margin - kRadius, first_column = columns.begin - margin - kRadius;
  for (int64_t i = 0; i < rows.size() + 2 * (margin + kRadius); ++i) {
    const int64_t row = first_row + i;
    const bool inside = row >= 0 && row < height;
    load_row(inside ? img1 + row * width : nullptr, inside ? img2 + row * width : nullptr, image.clamp, width,
             first_column, input_columns, s.x1[i], s.delta[i]);
  }

  for (int64_t i = 0; i < rows.size(); ++i) sums[i * across] = {};
  // The map's columns that count: for the value those of the tile, for the gradient all inside the image.
  const int64_t map_begin = columns.begin - margin;
  const int64_t exist_begin = std::max(rim - map_begin, int64_t(0));
  const int64_t exist_end = std::max(std::min(width - rim - map_begin, map_columns), exist_begin);
  const int64_t count_begin = std::max(exist_begin, margin);
  const int64_t count_end = std::min(exist_end, margin + columns.size());
  for (int64_t i = 0; i < rows.size() + 2 * margin; ++i) {
    const int64_t row = rows.begin - margin + i;
    auto* maps = args.gradient ? &s.maps[i] : nullptr;
    if (row >= rim && row < height - rim) {
      column_stats(s, i, input_columns);
      ssim_row(s, map_columns, maps);
      if (row >= rows.begin && row < rows.end && count_begin < count_end)
        sums[(row - rows.begin) * across].ssim = row_sum(s.row + count_begin, count_end - count_begin);
      if (maps)
        for (T* map : {maps->value, maps->slope1, maps->slope_delta}) {
          std::fill(map, map + exist_begin, T(0));
          std::fill(map + exist_end, map + map_columns, T(0));
        }
    } else if (maps) {
      for (T* map : {maps->value, maps->slope1, maps->slope_delta, maps->anchor1, maps->anchor_delta})
        std::fill(map, map + map_columns, T(0));
    }
    if (maps && i >= kReach) {
      gradient_row(s, i - kReach, round_up(columns.size(), lanes));
      T* to = args.gradient + (plane * height + rows.begin + i - kReach) * width + columns.begin;
      for (int64_t j = 0; j < columns.size(); ++j) to[j] = s.row[j] * T(gradient_scale);
    }
  }
  for (int64_t i = 0; i < rows.size(); ++i) {
    const T* delta = s.delta[i + margin + kRadius] + margin + kRadius;
    for (int64_t j = 0; j < columns.size(); ++j) s.row[j] = std::abs(delta[j]);
    sums[i * across].l1 = row_sum(s.row, columns.size());
  }
}

// Adds the sums of the rows tile by tile.
template <class T>
void means(const L1SsimMeans<T>& args, bool valid) {
  const auto& image = args.images;
  const Sums* sums = reinterpret_cast<const Sums*>(args.sums);
  const int64_t down = parts(image.height, kTileRows), across = row_parts<T>(image.width);
  const int64_t rim = valid ? kReach : 0;
  Sums total{};
  for (int64_t i = 0; i < image.planes * down * across; ++i) {
    const Range rows = part(image.height, down, i / across % down);
    Sums one{};
    for (int64_t row = rows.begin; row < rows.end; ++row) {
      const Sums& of_row = sums[(i / (down * across) * image.height + row) * across + i % across];
      one.l1 += of_row.l1;
      one.ssim += of_row.ssim;
    }
    total.l1 += one.l1;
    total.ssim += one.ssim;
  }
  *args.l1 = total.l1 / (double(image.planes) * double(image.height) * double(image.width));
  *args.ssim = total.ssim / (double(image.planes) * double(image.height - rim) * double(image.width - rim));
}

template <class T, class Source>
void all_tiles(const L1Ssim<T>& args, const Executor& executor) {
  const auto& image = args.images;
  const int64_t down = parts(image.height, kTileRows), across = row_parts<T>(image.width);
  const int64_t rim = args.valid ? kReach : 0;
  const double ssim_count = double(image.planes) * double(image.height - rim) * double(image.width - rim);
  std::vector<double> own_sums(args.rows ? 0 : 2 * image.planes * image.height * across);
  double* const all_sums = args.rows ? args.sums : own_sums.data();
  executor.run(image.planes * down * across, 1, [&](int64_t begin, int64_t end) {
    const std::unique_ptr<Scratch<T>> scratch(new Scratch<T>);
    for (int64_t i = begin; i < end; ++i) {
      const int64_t plane = i / (down * across);
      Range rows = part(image.height, down, i / across % down);
      if (args.rows) rows = {std::max(rows.begin, args.rows->begin), std::min(rows.end, args.rows->end)};
      if (rows.size() <= 0) continue;
      Sums* const sums = reinterpret_cast<Sums*>(all_sums) + (plane * image.height + rows.begin) * across + i % across;
      tile<T, Source>(args, plane, rows, part(image.width, across, i % across), 1 / ssim_count, *scratch, sums, across);
    }
  });
  if (!args.rows) means<T>({image, all_sums, args.l1, args.ssim}, args.valid);
}

template <class T, class Source>
void vjp_block(const T* img1, const Source* img2, bool clamp, const T* ssim_gradient, T by_l1, T by_ssim, int64_t n,
               T* out) {
  for (int64_t i = 0; i < n; ++i) {
    const T sum = by_ssim * ssim_gradient[i] + by_l1 * abs_difference_vjp(img1[i], to_value<T>(img2[i]));
    out[i] = clamp && !in_unit(img1[i]) ? T(0) : sum;
  }
}

template <class T, class Source>
void vjp(const L1SsimVjp<T>& args, const Executor& executor) {
  constexpr int64_t kBlock = 1 << 14;  // fixed, so that a pixel always has the same place in the vectorised loop
  const auto& image = args.images;
  const int64_t n = image.planes * image.height * image.width;
  const Source* img2 = static_cast<const Source*>(image.img2);
  // Whole blocks, also where a band begins or ends.
  const auto wanted = [&](int64_t begin, int64_t end) {
    if (!args.rows) return true;
    for (int64_t row = begin / image.width; row <= (end - 1) / image.width; ++row)
      if (row % image.height >= args.rows->begin && row % image.height < args.rows->end) return true;
    return false;
  };
  executor.run((n + kBlock - 1) / kBlock, 1, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin * kBlock; i < std::min(end * kBlock, n); i += kBlock)
      if (wanted(i, std::min(i + kBlock, n)))
        vjp_block(image.img1 + i, img2 + i, image.clamp, args.ssim_gradient + i, T(args.grad_l1 / double(n)),
                  T(args.grad_ssim), std::min(kBlock, n - i), args.grad_img1 + i);
  });
}

template <class T>
void dispatch(const L1Ssim<T>& args, const Executor& executor) {
  args.images.img2_is_bytes ? all_tiles<T, uint8_t>(args, executor) : all_tiles<T, T>(args, executor);
}

template <class T>
void dispatch(const L1SsimVjp<T>& args, const Executor& executor) {
  args.images.img2_is_bytes ? vjp<T, uint8_t>(args, executor) : vjp<T, T>(args, executor);
}

}  // namespace

void l1_ssim_cpu(const L1Ssim<float>& args, const Executor& executor) { dispatch(args, executor); }
void l1_ssim_cpu(const L1Ssim<double>& args, const Executor& executor) { dispatch(args, executor); }
void l1_ssim_means_cpu(const L1SsimMeans<float>& args) { means(args, false); }
void l1_ssim_means_cpu(const L1SsimMeans<double>& args) { means(args, false); }
void l1_ssim_vjp_cpu(const L1SsimVjp<float>& args, const Executor& executor) { dispatch(args, executor); }
void l1_ssim_vjp_cpu(const L1SsimVjp<double>& args, const Executor& executor) { dispatch(args, executor); }

GS_ISA_END
