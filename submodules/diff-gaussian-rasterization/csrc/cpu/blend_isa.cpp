// Blending, its backward and the decisive splats. A thread takes a tile, a vector takes pixels of one of its rows.
#include <algorithm>
#include <cstring>
#include <limits>
#include <memory>
#include <vector>

#include "../backend.h"
#include "../math/blend.h"
#include "../math/exp2.h"
#include "../math/footprint.h"
#include "../math/slots.h"
#include "../math/tiles.h"
#include "gs/simd.h"

GS_ISA_BEGIN

namespace {

constexpr int kPixels = kTile * kTile;
constexpr int64_t kChunk = 128;  // splats held local to a tile at once, some 5 KB of floats

// A tile's place in the image.
struct Tile {
  int x, y, columns, rows;  // px; columns and rows inside the image

  Tile(int64_t index, Image image) {
    const int per_row = tile_count(image.width);
    x = int(index % per_row) * kTile, y = int(index / per_row) * kTile;
    columns = std::min(kTile, image.width - x), rows = std::min(kTile, image.height - y);
  }
};

// Copies between an image plane and a tile's 16x16 array. Pixels outside the image stay unchanged.
template <class To, class From>
void read_tile(const From* plane, Image image, const Tile& tile, To* pixels) {
  for (int r = 0; r < tile.rows; ++r)
    std::copy_n(plane + int64_t(tile.y + r) * image.width + tile.x, tile.columns, pixels + r * kTile);
}
template <class To, class From>
void write_tile(const From* pixels, Image image, const Tile& tile, To* plane) {
  for (int r = 0; r < tile.rows; ++r)
    std::copy_n(pixels + r * kTile, tile.columns, plane + int64_t(tile.y + r) * image.width + tile.x);
}

template <class T>
void gather(const BlendInput<T>& in, const Tile& tile, int64_t begin, int64_t end, LocalSplat<T>* local) {
  for (int64_t k = begin; k < end; ++k) {
    Splat<T> splat;
    std::memcpy(&splat, in.splats + kSplatValues * int64_t(in.instances[k]), sizeof splat);
    *local++ = localise(splat, T(tile.x), T(tile.y));
  }
}

template <class T>
typename Simd<T>::Vec lane_x(int first) {
  T x[Simd<T>::kLanes];
  for (int i = 0; i < Simd<T>::kLanes; ++i) x[i] = T(first + i);
  return Simd<T>::load(x);
}

// The state of a tile's pixels between two splats. A strip of lanes is a part of one of its rows.
template <class T>
struct ForwardState {
  alignas(64) T transmittance[kPixels], color[3][kPixels], depth[kPixels];
  alignas(64) T threshold[kPixels];  // log2 alpha that a splat must reach; infinite once the pixel has ended
  alignas(64) typename IntOf<T>::type last[kPixels];
};

// Blends splats [0, count) of a batch into one strip. Returns false once all its pixels have ended.
template <class T, bool kDepth, bool kLast>
bool blend_strip(const LocalSplat<T>* splats, int64_t count, int64_t position, int row, int first,
                 ForwardState<T>& state) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  const int at = row * kTile + first;
  const T least = T(kLog2MinAlpha), least_left = T(kMinTransmittance);
  const V x = lane_x<T>(first), zero = {}, never = zero + std::numeric_limits<T>::infinity();
  V left = S::load(state.transmittance + at), threshold = S::load(state.threshold + at);
  V red = S::load(state.color[0] + at), green = S::load(state.color[1] + at), blue = S::load(state.color[2] + at);
  V depth = zero;
  M last = {};
  if (kDepth) depth = S::load(state.depth + at);
  if (kLast) std::memcpy(&last, state.last + at, sizeof last);
  bool open = S::any(threshold < never);
  for (int64_t k = 0; open && k < count; ++k) {
    const LocalSplat<T>& splat = splats[k];
    const RowTerms<T> terms = row_terms(splat, T(row));
    if (!(terms.top >= least)) continue;
    const V t = row_exponent(terms, row_u(terms, x));
    M reached = t >= threshold;
    if (!S::any(reached)) continue;
    const V alpha = capped<V, T>(exp2_lanes<V, M>(reached ? t : zero, T()));
    const V after = left - alpha * left;
    const M ends = reached & (after < least_left);
    if (S::any(ends)) {
      threshold = ends ? never : threshold;
      reached &= ~ends;
      open = S::any(threshold < never);
    }
    const V weight = reached ? alpha * left : zero;
    red += weight * splat.r, green += weight * splat.g, blue += weight * splat.b;
    if (kDepth) depth += weight * splat.inverse_depth;
    if (kLast) last = reached ? M{} + typename S::Int(position + k + 1) : last;
    left = reached ? after : left;
  }
  S::store(state.transmittance + at, left), S::store(state.threshold + at, threshold);
  S::store(state.color[0] + at, red), S::store(state.color[1] + at, green), S::store(state.color[2] + at, blue);
  if (kDepth) S::store(state.depth + at, depth);
  if (kLast) std::memcpy(state.last + at, &last, sizeof last);
  return open;
}

// Goes through a tile's list front to back, kChunk splats at a time, for each strip of its pixels. strip(splats, count,
// position of the first in the list, row, first column) tells whether a pixel is still open. Pixels outside the image
// never are.
template <class T, class Strip>
void through_tile(const BlendInput<T>& in, const Tile& tile, int64_t index, T* threshold, const Strip& strip) {
  for (int p = 0; p < kPixels; ++p)
    threshold[p] = p % kTile < tile.columns ? T(kLog2MinAlpha) : std::numeric_limits<T>::infinity();
  LocalSplat<T> local[kChunk];
  const int64_t begin = in.ranges[index], end = in.ranges[index + 1];
  bool open = true;
  for (int64_t from = begin; open && from < end; from += kChunk) {
    const int64_t to = std::min(from + kChunk, end);
    gather(in, tile, from, to, local);
    open = false;
    for (int row = 0; row < tile.rows; ++row)
      for (int first = 0; first < kTile; first += Simd<T>::kLanes)
        open |= strip(local, to - from, from - begin, row, first);
  }
}

template <class T, bool kDepth, bool kLast>
void blend_tile(const BlendInput<T>& in, int64_t index, const Blended<T>& out) {
  const Tile tile(index, in.image);
  ForwardState<T> state;
  std::fill_n(state.transmittance, kPixels, T(1));
  std::fill_n(state.color[0], 3 * kPixels, T(0));
  if (kDepth) std::fill_n(state.depth, kPixels, T(0));
  if (kLast) std::fill_n(state.last, kPixels, 0);
  through_tile(in, tile, index, state.threshold,
               [&](const LocalSplat<T>* local, int64_t count, int64_t position, int row, int first) {
                 return blend_strip<T, kDepth, kLast>(local, count, position, row, first, state);
               });
  for (int c = 0; c < 3; ++c) {
    for (int p = 0; p < kPixels; ++p) state.color[c][p] += state.transmittance[p] * in.background[c];
    write_tile(state.color[c], in.image, tile, out.color + int64_t(c) * in.image.width * in.image.height);
  }
  write_tile(state.transmittance, in.image, tile, out.transmittance);
  if (kDepth) write_tile(state.depth, in.image, tile, out.inverse_depth);
  if (kLast) write_tile(state.last, in.image, tile, out.last);
}

template <class T>
struct BackwardState {
  alignas(64) T transmittance[kPixels], behind[kPixels];
  alignas(64) T color[3][kPixels], depth[kPixels];  // the image's gradient
  alignas(64) typename IntOf<T>::type last[kPixels];
};

// Sums one splat's kGradientValues over a tile. Returns whether the splat reaches a pixel.
template <class T, bool kDepth>
bool splat_gradient(const LocalSplat<T>& splat, int64_t position, const Tile& tile, BackwardState<T>& state, T* sums) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  const T least = T(kLog2MinAlpha);
  const V zero = {};
  // The rows that the splat can reach, and one to spare at either end; the exact test follows.
  const T reach = std::sqrt(larger(splat.log2_opacity - least, T(0))) / splat.l22 + 1;
  const int row_begin = clamped_floor(splat.y - reach, tile.rows);
  const int row_end = clamped_floor(splat.y + reach + 1, tile.rows);
  V q0 = zero, qu = zero, qv = zero, quu = zero, quv = zero, qvv = zero;
  V red = zero, green = zero, blue = zero, depth = zero;
  bool any = false;
  for (int row = row_begin; row < row_end; ++row) {
    const RowTerms<T> terms = row_terms(splat, T(row));
    if (!(terms.top >= least)) continue;
    for (int first = 0; first < kTile; first += S::kLanes) {
      const int at = row * kTile + first;
      M last;
      std::memcpy(&last, state.last + at, sizeof last);
      const V u = row_u(terms, lane_x<T>(first));
      const V t = row_exponent(terms, u);
      const M reached = (t >= least) & (last > typename S::Int(position));
      if (!S::any(reached)) continue;
      any = true;
      const V uncapped = reached ? exp2_lanes<V, M>(reached ? t : zero, T()) : zero;
      const V alpha = capped<V, T>(uncapped);
      V left = S::load(state.transmittance + at), behind = S::load(state.behind + at);
      const V gr = S::load(state.color[0] + at), gg = S::load(state.color[1] + at), gb = S::load(state.color[2] + at);
      V gd = zero;
      V value = splat.r * gr + splat.g * gg + splat.b * gb;
      if (kDepth) gd = S::load(state.depth + at), value += splat.inverse_depth * gd;
      const V q = uncapped * alpha_gradient<T, V>(alpha, value, left, behind);
      const V weight = alpha * left;
      S::store(state.transmittance + at, left), S::store(state.behind + at, behind);
      const V qu_here = q * u, qv_here = q * terms.v;
      q0 += q, qu += qu_here, qv += qv_here;
      quu += qu_here * u, quv += qu_here * terms.v, qvv += qv_here * terms.v;
      red += weight * gr, green += weight * gg, blue += weight * gb;
      if (kDepth) depth += weight * gd;
    }
  }
  if (!any) return false;
  const V all[kGradientValues] = {q0, qu, qv, quu, quv, qvv, red, green, blue, depth};
  for (int i = 0; i < kGradientValues; ++i) sums[i] = S::sum(all[i]);
  return true;
}

// Sums of the processed instances, a row of kGradientValues each, in the order of slots: those of a splat lie side by
// side, whatever tiles they come from. A bit per slot tells which instances were processed, and a prefix sum over the
// bits tells where a row is. So memory is for these rows only, and nothing is added concurrently.
template <class T>
class GradientRows {
 public:
  explicit GradientRows(int64_t slots) : bits_((slots + 63) / 64, 0), before_(bits_.size() + 1, 0) {}

  void mark(int64_t slot) { __atomic_fetch_or(&bits_[slot >> 6], uint64_t(1) << (slot & 63), __ATOMIC_RELAXED); }

  void allocate() {
    for (size_t w = 0; w < bits_.size(); ++w) before_[w + 1] = before_[w] + __builtin_popcountll(bits_[w]);
    rows_.reset(new T[kGradientValues * before_.back()]);  // not zeroed: every row is written
  }

  // The row of a slot; for a slot without one, the next row.
  T* row(int64_t slot) {
    const uint64_t lower = (uint64_t(1) << (slot & 63)) - 1;
    const int64_t rank = before_[slot >> 6] + (slot & 63 ? __builtin_popcountll(bits_[slot >> 6] & lower) : 0);
    return rows_.get() + kGradientValues * rank;
  }

 private:
  std::vector<uint64_t> bits_;
  std::vector<int64_t> before_;
  std::unique_ptr<T[]> rows_;
};

template <class T, bool kDepth>
void blend_tile_vjp(const BlendInput<T>& in, const BlendGradient<T>& g, int64_t index, int64_t processed,
                    GradientRows<T>& rows) {
  const Tile tile(index, in.image);
  const int64_t begin = in.ranges[index], plane = int64_t(in.image.width) * in.image.height;
  BackwardState<T> state;
  std::fill_n(state.last, kPixels, 0);
  std::fill_n(state.transmittance, kPixels, T(1));
  std::fill_n(state.behind, kPixels, T(0));
  std::fill_n(state.color[0], 3 * kPixels, T(0));
  std::fill_n(state.depth, kPixels, T(0));
  read_tile(g.last, in.image, tile, state.last);
  read_tile(g.transmittance, in.image, tile, state.transmittance);
  for (int c = 0; c < 3; ++c) read_tile(g.color + c * plane, in.image, tile, state.color[c]);
  if (kDepth) read_tile(g.inverse_depth, in.image, tile, state.depth);
  if (g.transmittance_gradient) read_tile(g.transmittance_gradient, in.image, tile, state.behind);
  for (int p = 0; p < kPixels; ++p)
    for (int c = 0; c < 3; ++c) state.behind[p] += in.background[c] * state.color[c][p];

  LocalSplat<T> local[kChunk];
  for (int64_t to = processed; to > 0; to -= std::min(kChunk, to)) {
    const int64_t from = std::max<int64_t>(0, to - kChunk);
    gather(in, tile, begin + from, begin + to, local);
    for (int64_t k = to - 1; k >= from; --k) {
      T* sums = rows.row(slot_of(g.slots, in.instances[begin + k], tile.x / kTile, tile.y / kTile));
      if (!splat_gradient<T, kDepth>(local[k - from], k, tile, state, sums)) std::fill_n(sums, kGradientValues, T(0));
    }
  }
}

// Marks the splats of a batch, [0, count), that are decisive for a strip: a pixel blends splats up to its `last`,
// and the next splat that reaches the pixel ends it. Returns false once all the strip's pixels have ended.
template <class T>
bool mark_strip(const LocalSplat<T>* splats, const int32_t* instances, int64_t count, int64_t position, int row,
                int first, const typename IntOf<T>::type* last_of_tile, T* threshold_of_tile, bool* decisive) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  const int at = row * kTile + first;
  const V x = lane_x<T>(first), never = V{} + std::numeric_limits<T>::infinity();
  V threshold = S::load(threshold_of_tile + at);
  M last;
  std::memcpy(&last, last_of_tile + at, sizeof last);
  bool open = S::any(threshold < never);
  for (int64_t k = 0; open && k < count; ++k) {
    const RowTerms<T> terms = row_terms(splats[k], T(row));
    if (!(terms.top >= T(kLog2MinAlpha))) continue;
    const M reached = row_exponent(terms, row_u(terms, x)) >= threshold;
    if (!S::any(reached)) continue;
    __atomic_store_n(decisive + instances[k], true, __ATOMIC_RELAXED);
    threshold = reached & (last <= typename S::Int(position + k)) ? never : threshold;
    open = S::any(threshold < never);
  }
  S::store(threshold_of_tile + at, threshold);
  return open;
}

template <class T>
void mark_tile(const BlendInput<T>& in, const int32_t* last_plane, int64_t index, bool* decisive) {
  const Tile tile(index, in.image);
  alignas(64) T threshold[kPixels];
  alignas(64) typename IntOf<T>::type last[kPixels] = {};
  read_tile(last_plane, in.image, tile, last);
  const int32_t* instances = in.instances + in.ranges[index];
  through_tile(in, tile, index, threshold,
               [&](const LocalSplat<T>* local, int64_t count, int64_t position, int row, int first) {
                 return mark_strip(local, instances + position, count, position, row, first, last, threshold, decisive);
               });
}

}  // namespace

template <class T>
void mark_decisive(const Executor& executor, const BlendInput<T>& in, const int32_t* last, bool* decisive) {
  const int64_t tiles = tiles_of(in.image);
  for_dynamic(executor, tiles, 1, [&](int64_t tile, int64_t) { mark_tile(in, last, tile, decisive); });
}

template <class T>
void blend(const Executor& executor, const BlendInput<T>& in, const Blended<T>& out) {
  const auto run = out.inverse_depth ? (out.last ? blend_tile<T, true, true> : blend_tile<T, true, false>)
                                     : (out.last ? blend_tile<T, false, true> : blend_tile<T, false, false>);
  const int64_t tiles = tiles_of(in.image);
  for_dynamic(executor, tiles, 1, [&](int64_t tile, int64_t) { run(in, tile, out); });
}

template <class T>
void blend_vjp(const Executor& executor, const BlendInput<T>& in, const BlendGradient<T>& g) {
  const int64_t tiles = tiles_of(in.image);
  GradientRows<T> rows(g.slot_count);
  std::vector<int32_t> processed(tiles);
  for_dynamic(executor, tiles, 4, [&](int64_t begin, int64_t end) {
    for (int64_t index = begin; index < end; ++index) {
      const Tile tile(index, in.image);
      int32_t last[kPixels] = {};
      read_tile(g.last, in.image, tile, last);
      processed[index] = *std::max_element(last, last + kPixels);
      for (int64_t k = 0; k < processed[index]; ++k)
        rows.mark(slot_of(g.slots, in.instances[in.ranges[index] + k], tile.x / kTile, tile.y / kTile));
    }
  });
  rows.allocate();
  const auto run = g.inverse_depth ? blend_tile_vjp<T, true> : blend_tile_vjp<T, false>;
  for_dynamic(executor, tiles, 1, [&](int64_t tile, int64_t) { run(in, g, tile, processed[tile], rows); });
  for_dynamic(executor, g.count, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      double sums[kGradientValues] = {};  // a splat may have thousands of tiles
      const T* stop = rows.row(g.slots[i + 1].first);
      for (const T* row = rows.row(g.slots[i].first); row < stop; row += kGradientValues)
        for (int v = 0; v < kGradientValues; ++v) sums[v] += row[v];
      std::copy_n(sums, kGradientValues, g.moments + kGradientValues * i);
    }
  });
}

#define GS_INSTANTIATE(T)                                                                     \
  template void blend<T>(const Executor&, const BlendInput<T>&, const Blended<T>&);           \
  template void blend_vjp<T>(const Executor&, const BlendInput<T>&, const BlendGradient<T>&); \
  template void mark_decisive<T>(const Executor&, const BlendInput<T>&, const int32_t* last, bool* decisive);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
