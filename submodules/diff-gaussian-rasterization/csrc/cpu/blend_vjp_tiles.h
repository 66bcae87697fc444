#pragma once
// The backward of blending, up to gradient rows or to their sums. A thread takes a tile, a vector takes pixels of one
// or two of its rows.
#include <memory>
#include <vector>

#include "../backend.h"
#include "../math/absolute.h"
#include "../math/exp2.h"
#include "../math/slots.h"
#include "further_channels.h"
#include "row_table.h"

GS_ISA_BEGIN

namespace {

// Sums of an instance: kGradientRow, and perhaps kAbsoluteValues.
template <int kRays, bool kAbsolute>
constexpr int kSums = kGradientRow<kRays> + (kAbsolute ? kAbsoluteValues : 0);
template <class T, int kRays, bool kAbsolute>
using Sums = typename Simd<T>::Vec[kSums<kRays, kAbsolute>];

// The moments of a splat's pixels, lane by lane, as a gradient row has them.
template <class T, int kRays, bool kAbsolute>
struct PixelSums {
  using V = typename Simd<T>::Vec;
  V q = {}, u = {}, v = {}, uu = {}, uv = {}, vv = {}, absolute_u = {}, absolute_uv = {};

  void add(const Chunk<T, kBatch, kNoRays>& chunk, int k, const RowTerms<V>& terms, V u_here, V q_here) {
    const V qu = q_here * u_here, qv = q_here * terms.v;
    q += q_here, u += qu, v += qv;
    uu += qu * u_here, uv += qu * terms.v, vv += qv * terms.v;
    if (kAbsolute) {
      absolute_u += magnitude(qu);
      absolute_uv += magnitude(V(chunk.l12[k] * qu + chunk.l22[k] * qv));
    }
  }
};
template <class T, bool kAbsolute>
struct PixelSums<T, kPinholeRays, kAbsolute> {
  using V = typename Simd<T>::Vec;
  V q = {}, u = {}, v = {}, uu = {}, uv = {}, vv = {}, pu = {}, pv = {}, pp = {}, absolute_u = {}, absolute_uv = {};

  void add(const Chunk<T, kBatch, kPinholeRays>& chunk, int k, const RayRow<V>& terms, const AtPixel<V>& p, V q_here) {
    add_weights(chunk.l12[k], chunk.l22[k], ray_weights(terms, p, chunk.slope_v[k]), q_here);
  }
  void add_weights(T l12, T l22, const RayWeights<V>& at, V q_here) {
    const V along = q_here * at.u, down = q_here * at.v, deep = q_here * at.p;
    // Fused by name: kAbsolute must not matter.
    q += q_here, u = multiply_add(q_here, at.au, u), v = multiply_add(q_here, at.av, v);
    uu += along * at.u, uv += along * at.v, vv += down * at.v;
    pu += deep * at.u, pv += deep * at.v, pp += deep * at.p;
    if (kAbsolute) {
      const V qu = q_here * at.au, qv = q_here * at.av;
      absolute_u += magnitude(qu);
      absolute_uv += magnitude(V(l12 * qu + l22 * qv));
    }
  }
};

template <class T, bool kAbsolute>
struct PixelSums<T, kLensRays, kAbsolute> : PixelSums<T, kPinholeRays, kAbsolute> {
  using V = typename Simd<T>::Vec;
  void add(const Chunk<T, kBatch, kLensRays>& chunk, int k, const LensTerms<T>& terms, const AtPlace<V>& p, V q_here) {
    this->add_weights(chunk.l12[k], chunk.l22[k], ray_weights(terms, p), q_here);
  }
};

// A batch of splats in a tile, to be taken back to front.
template <class T, int kRays>
struct Batch {
  Chunk<T, kBatch, kRays> chunk;
  ColumnRanges<T> columns;
  RowTable<T, kRays> table;
};

// The columns of a vector's pixels, or their places.
template <class T, int kRays>
auto pixels_at(const BackwardState<T, kRays>& state, int at, int column) {
  if constexpr (kRays == kLensRays)
    return state.in_place.from(at, column);
  else
    return columns_from<T>(0) + T(column);
}

// Sums one splat's values, lane by lane, over the rows with a bit, in vectors from column `first` on, until `end`.
// k: the splat in its batch.
template <class T, int kRays, int kPayload, bool kAbsolute>
__attribute__((always_inline)) inline void sum_rows(const Batch<T, kRays>& batch, int k, int64_t position,
                                                    uint32_t bits, int first, int end, BackwardState<T, kRays>& state,
                                                    FurtherSums<T, kPayload>& further,
                                                    Sums<T, kRays, kAbsolute>& sums) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  const Chunk<T, kBatch, kRays>& chunk = batch.chunk;
  const RowTable<T, kRays>& table = batch.table;
  const V zero = {};
  PixelSums<T, kRays, kAbsolute> moments;
  V payload[kLeading] = {};
  for (; bits; bits &= bits - 1) {
    const int row = __builtin_ctz(bits);
    const auto terms = table.of(chunk, row, k);
    int column = first;
    do {
      const int at = place<T>(row, column);
      M last;
      std::memcpy(&last, state.last + at, sizeof last);
      const auto pixel = at_pixel(terms, pixels_at(state, at, column));
      const V t = row_exponent(terms, pixel);
      const M reached = (t >= T(kLog2MinAlpha)) & (last > typename S::Int(position));
      if (!S::any(reached)) continue;
      const V uncapped = reached ? exp2_lanes<V, M>(reached ? t : zero, T()) : zero;
      const V alpha = capped<V, T>(uncapped, further.cap());
      V left = S::load(state.transmittance + at), behind = S::load(state.behind + at);
      V gradient[kWidth<kPayload>];
      for (int c = 0; c < kWidth<kPayload>; ++c) gradient[c] = reached ? S::load(state.payload[c] + at) : zero;
      V value = chunk.payload[0][k] * gradient[0];
      for (int c = 1; c < kWidth<kPayload>; ++c) value += chunk.payload[c][k] * gradient[c];
      if constexpr (kPayload == kChannels) value = further.value(value, at);
      V q = uncapped * alpha_gradient<T, V>(reached, alpha, value, left, behind);
      if constexpr (kPayload == kChannels) q = further.slope(q, uncapped);
      const V weight = alpha * left;
      S::store(state.transmittance + at, left), S::store(state.behind + at, behind);
      moments.add(chunk, k, terms, pixel, q);
      for (int c = 0; c < kWidth<kPayload>; ++c) payload[c] += weight * gradient[c];
      if constexpr (kPayload == kChannels) further.weigh(at, weight);
    } while ((column += kColumns<T>) < end && RowTable<T, kRays>::kParts == 1);
  }
  const auto& m = moments;
  if constexpr (kRays != kNoRays) {
    const V all[] = {m.q,        m.u,        m.v,  m.uu, m.uv, m.vv, payload[0],   payload[1],
                     payload[2], payload[3], m.pu, m.pv, m.pp, zero, m.absolute_u, m.absolute_uv};
    std::copy_n(all, kSums<kRays, kAbsolute>, sums);
  } else {
    const V all[] = {m.q,        m.u,        m.v,        m.uu,       m.uv,         m.vv,
                     payload[0], payload[1], payload[2], payload[3], m.absolute_u, m.absolute_uv};
    std::copy_n(all, kSums<kRays, kAbsolute>, sums);
  }
}

// Sums one splat's values over the pixels that it reaches, all of them from column `first` to `last`.
template <class T, int kRays, int kPayload, bool kAbsolute>
void splat_gradient(const Batch<T, kRays>& batch, int k, int64_t position, BackwardState<T, kRays>& state,
                    FurtherSums<T, kPayload>& further, T* out) {
  constexpr int kParts = RowTable<T, kRays>::kParts;
  const int first = batch.columns.first[k], wide = batch.columns.last[k] - first;
  Sums<T, kRays, kAbsolute> sums;
  if (wide < kColumns<T>) {  // one vector a row, which may begin at any column: that changes no sum
    const int begin = std::min(first, kTile - kColumns<T>);
    sum_rows<T, kRays, kPayload, kAbsolute>(batch, k, position, batch.table.rows(k), begin, begin + 1, state, further,
                                            sums);
  } else {
    const int vectors = wide / kColumns<T> + 1, begin = std::min(first, kTile - vectors * kColumns<T>);
    Sums<T, kRays, kAbsolute> parts[kParts];
    for (int p = 0; p < kParts; ++p) {
      const int from = kParts > 1 ? p * kColumns<T> : begin;
      sum_rows<T, kRays, kPayload, kAbsolute>(batch, k, position, batch.table.rows(k, p), from,
                                              begin + vectors * kColumns<T>, state, further, parts[p]);
    }
    for (int i = 0; i < kSums<kRays, kAbsolute>; ++i) {
      sums[i] = parts[0][i];
      for (int p = 1; p < kParts; ++p) sums[i] += parts[p][i];
    }
  }
  LaneSums<T, int(sizeof sums[0])>::store(sums, out);
}

// Sums of the processed instances, a row of kRow each, in the order of slots: those of a splat lie side by side,
// whatever tiles they come from. A mark per slot tells which instances were processed, and a prefix sum over the marks
// tells where a row is. So memory is for these rows only, and nothing is added concurrently.
template <class T, int kRow>
class GradientRows {
 public:
  explicit GradientRows(int64_t slots) : marks_((slots + 63) / 64 * 64, 0), bits_(marks_.size() / 64) {}

  void mark(int64_t slot) { marks_[slot] = 1; }

  // memory: gives room for as many rows as it is asked for. It need not be zeroed: every row is written.
  template <class Memory>
  void allocate(const Memory& memory) {
    before_.resize(bits_.size() + 1);
    before_[0] = 0;
    for (size_t w = 0; w < bits_.size(); ++w) {
      uint64_t bits = 0;
      for (int i = 0; i < 8; ++i) {
        uint64_t marks;  // of 8 slots, the first in the lowest byte
        std::memcpy(&marks, &marks_[64 * w + 8 * i], sizeof marks);
        bits |= (marks * 0x0102040810204080 >> 56) << 8 * i;
      }
      bits_[w] = bits;
      before_[w + 1] = before_[w] + __builtin_popcountll(bits);
    }
    rows_ = memory(before_.back());
  }

  // The number of a slot's row; for a slot without one, of the next row.
  int64_t number(int64_t slot) const {
    const uint64_t lower = (uint64_t(1) << (slot & 63)) - 1;
    return before_[slot >> 6] + (slot & 63 ? __builtin_popcountll(bits_[slot >> 6] & lower) : 0);
  }
  T* row(int64_t slot) const { return rows_ + kRow * number(slot); }

 private:
  std::vector<uint8_t> marks_;
  std::vector<uint64_t> bits_;
  std::vector<int64_t> before_;
  T* rows_ = nullptr;
};

// Reads where the tile's pixels ended.
template <class T, int kRays>
void read_ends(const BlendInput<T>& in, const BlendGradient<T>& g, const Tile& tile, int64_t index,
               BackwardState<T, kRays>& state) {
  std::fill_n(state.last, kPixels, 0);
  std::fill_n(state.transmittance, kPixels, T(1));
  read_tile(g.last, in.image, tile, state.last);
  read_tile(g.transmittance, in.image, tile, state.transmittance);
  for (int row = 0; row < kTile; ++row)
    state.row_last[row] = *std::max_element(state.last + row * kTile, state.last + (row + 1) * kTile);
  if constexpr (kRays == kLensRays) {
    state.in_place = state.places = TilePlaces<T, kRays>(in, index);
    interleave<T>(state.in_place.x), interleave<T>(state.in_place.y);
  }
  interleave<T>(state.last), interleave<T>(state.transmittance);
}

template <class T, int kRays, int kPayload>
void read_state(const BlendInput<T>& in, const BlendGradient<T>& g, const Tile& tile, int64_t index,
                BackwardState<T, kRays>& state, FurtherSums<T, kPayload>& further) {
  const int64_t plane = int64_t(in.image.width) * in.image.height;
  std::fill_n(state.payload[0], kLeading * kPixels, T(0));
  std::fill_n(state.behind, kPixels, T(0));
  if (g.inverse_depth) read_tile(g.inverse_depth, in.image, tile, state.payload[3]), interleave<T>(state.payload[3]);
  if (g.transmittance_gradient) read_tile(g.transmittance_gradient, in.image, tile, state.behind);
  for (int64_t c = 0; c < in.planes(); ++c) {
    T* pixels = c < kLeading ? state.payload[c] : further.plane(c);
    if (kPayload == kChannels)
      each_pixel(in.image, tile,
                 [&](int to, int64_t from) { pixels[to] = g.color[c * in.channels.plane + in.channels.pixel * from]; });
    else
      read_tile(g.color + c * plane, in.image, tile, pixels);
    for (int p = 0; p < kPixels; ++p) state.behind[p] += in.background[c] * pixels[p];
    interleave<T>(pixels);
  }
  read_ends(in, g, tile, index, state);
  interleave<T>(state.behind);
  if constexpr (kPayload == kChannels) {
    typename Simd<T>::Vec none = {};  // the gradient of each channel is a part of `behind`
    for (int p = 0; p < kPixels; p += Simd<T>::kLanes) none += 0 * Simd<T>::load(state.behind + p);
    further.finite = !Simd<T>::any(none != none);
  }
}

template <class T, int kRays, int kPayload, bool kAbsolute>
void blend_tile_vjp(const BlendInput<T>& in, const BlendGradient<T>& g, int64_t index, int64_t processed,
                    const GradientRows<T, kSums<kRays, kAbsolute>>& rows, const PassRows<T>& pass) {
  const Tile tile(index, in.image);
  const int64_t begin = in.ranges[index];
  BackwardState<T, kRays> state;
  FurtherSums<T, kPayload> further(in.channels);
  read_state(in, g, tile, index, state, further);
  Batch<T, kRays> batch;
  for (int64_t to = processed; to > 0; to -= std::min<int64_t>(kBatch, to)) {
    const int64_t from = std::max<int64_t>(0, to - kBatch), count = to - from;
    batch.chunk.gather(in, tile, index, begin + from, count);
    for (int64_t k = begin + from; k < begin + to; ++k) __builtin_prefetch(g.slots + in.instances[k]);
    prefetch_splats(in, begin + std::max<int64_t>(0, from - kBatch), begin + from);
    batch.columns.find(batch.chunk, count, state.places);
    batch.table.fill(batch.chunk, count, from, state);
    for (int64_t position = to - 1; position >= from; --position) {
      const int32_t splat = in.instances[begin + position];
      const int64_t slot = slot_of(g.slots, splat, tile.x / kTile, tile.y / kTile);
      const auto sum_into = [&](T* to) {
        splat_gradient<T, kRays, kPayload, kAbsolute>(batch, int(position - from), position, state, further, to);
      };
      if constexpr (kPayload == kChannels) {
        T sums[kSums<kRays, kAbsolute>];
        further.start(splat), sum_into(sums);
        further.store(sums, pass, rows.number(slot), rows.row(slot));
      } else {
        sum_into(rows.row(slot));
      }
    }
  }
}

// Marks the slots of the instances that some pixel has processed. Returns how far into each tile's list they reach.
template <class T, int kRow>
std::vector<int32_t> mark_rows(const Executor& executor, const BlendInput<T>& in, const BlendGradient<T>& g,
                               GradientRows<T, kRow>& rows) {
  const int64_t tiles = tiles_of(in.image);
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
  return processed;
}

// The passes over channels.
template <class T, int kRays, bool kAbsolute>
void fill_passes(const Executor& executor, const BlendInput<T>& in, const BlendGradient<T>& g,
                 const std::vector<int32_t>& processed, const GradientRows<T, kSums<kRays, kAbsolute>>& rows) {
  T* const values = g.values_apart(in.channels) ? g.values : nullptr;
  const auto first_row = [&](int64_t splat) { return rows.number(g.slots[splat].first); };
  const std::unique_ptr<T[]> channels(values ? new T[kMostChannels * first_row(g.count)] : nullptr);
  each_pass(in, [&](int64_t first, const BlendInput<T>& pass, int64_t plane) {
    BlendGradient<T> gradient = g;
    gradient.color += plane;
    if (first > 0) gradient.transmittance_gradient = nullptr;
    for_dynamic(executor, tiles_of(in.image), 1, [&](int64_t tile, int64_t) {
      blend_tile_vjp<T, kRays, kChannels, kAbsolute>(pass, gradient, tile, processed[tile], rows,
                                                     {channels.get(), first > 0});
    });
    for_dynamic(executor, values ? g.count : 0, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        double sums[kMostChannels] = {};  // a splat may have thousands of tiles
        for (int64_t row = first_row(i); row < first_row(i + 1); ++row)
          for (int64_t c = 0; c < pass.channels.count; ++c) sums[c] += channels[kMostChannels * row + c];
        std::copy_n(sums, pass.channels.count, values + in.channels.count * i + first);
      }
    });
  });
}

template <class T, int kRays, bool kAbsolute, class Memory>
GradientRows<T, kSums<kRays, kAbsolute>> fill_rows(const Executor& executor, const BlendInput<T>& in,
                                                   const BlendGradient<T>& g, const Memory& memory) {
  GradientRows<T, kSums<kRays, kAbsolute>> rows(g.slot_count);
  const std::vector<int32_t> processed = mark_rows(executor, in, g, rows);
  rows.allocate(memory);
  if constexpr (kRays != kLensRays)
    if (in.channels.count) return fill_passes<T, kRays, kAbsolute>(executor, in, g, processed, rows), rows;
  const auto run = g.inverse_depth ? blend_tile_vjp<T, kRays, kColorAndDepth, kAbsolute>
                                   : blend_tile_vjp<T, kRays, kColor, kAbsolute>;
  for_dynamic(executor, tiles_of(in.image), 1,
              [&](int64_t tile, int64_t) { run(in, g, tile, processed[tile], rows, {}); });
  return rows;
}

// Sums the rows of splat i, from `start` to `stop`.
template <class T, int kRays, bool kAbsolute>
GS_ONE_COPY void sum_splat(const T* start, const T* stop, int64_t i, const RowSums<T>& to) {
  constexpr int kRow = kSums<kRays, kAbsolute>;
  double sums[kRow] = {};  // a splat may have thousands of tiles
  for (const T* row = start; row < stop; row += kRow)
    for (int v = 0; v < kRow; ++v) sums[v] += row[v];
  std::copy_n(sums, kGradientRow<kRays>, to.moments + kGradientRow<kRays> * i);
  if constexpr (kAbsolute) {
    const double* absolute = sums + kGradientRow<kRays>;
    to.absolute[i] = 0;
    if (start < stop)  // else the splat is undefined
      to.absolute[i] = absolute_length(to.splats[kSplatRow<kRays> * i + 2], T(absolute[0]), T(absolute[1]), to.image);
  }
}

// begin(i): where the rows of splat i begin, and those of the splat in front of it end.
template <class T, int kRays, bool kAbsolute, class Begin>
void sum_splats(const Executor& executor, int64_t count, const Begin& begin, const RowSums<T>& to) {
  for_dynamic(executor, count, 1024, [&](int64_t first, int64_t end) {
    for (int64_t i = first; i < end; ++i) sum_splat<T, kRays, kAbsolute>(begin(i), begin(i + 1), i, to);
  });
}

template <class T, int kRays, bool kAbsolute>
void sum_gradients(const Executor& executor, const BlendInput<T>& in, const BlendGradient<T>& g) {
  std::unique_ptr<T[]> memory;
  const auto rows = fill_rows<T, kRays, kAbsolute>(executor, in, g, [&](int64_t count) {
    memory.reset(new T[kSums<kRays, kAbsolute> * count]);
    return memory.get();
  });
  sum_splats<T, kRays, kAbsolute>(executor, g.count, [&](int64_t i) { return rows.row(g.slots[i].first); },
                                  {in.splats, in.image, g.moments, g.absolute});
  if (!g.values || g.values_apart(in.channels)) return;
  for (int64_t i = 0; i < g.count; ++i)
    std::copy_n(g.moments + kGradientRow<kRays> * i + kColorMoment, in.channels.count,
                g.values + in.channels.count * i);
}

template <class T, int kRays, bool kAbsolute>
void keep_rows(const Executor& executor, const BlendInput<T>& in, const BlendGradient<T>& g,
               const RowMemory<T>& memory) {
  const auto take = [&](int64_t count) { return memory.take(memory.context, count); };
  const auto rows = fill_rows<T, kRays, kAbsolute>(executor, in, g, take);
  for_dynamic(executor, g.count, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      memory.counts[i] =
          int32_t((rows.row(g.slots[i + 1].first) - rows.row(g.slots[i].first)) / kSums<kRays, kAbsolute>);
  });
}

// Sums the gradient rows that the caller has, which lie splat after splat.
template <class T, int kRays, bool kAbsolute>
void sum_given(const Executor& executor, const SplatRows<T>& in, const RowSums<T>& to) {
  std::vector<const T*> begin(in.count + 1, in.rows);
  for (int64_t i = 0; i < in.count; ++i) begin[i + 1] = begin[i] + kSums<kRays, kAbsolute> * int64_t(in.counts[i]);
  sum_splats<T, kRays, kAbsolute>(executor, in.count, [&](int64_t i) { return begin[i]; }, to);
}

}  // namespace

// In a file of its own, as project_on_rays.
template <class T>
void blend_vjp_lens_rays(const Executor&, const BlendInput<T>&, const BlendGradient<T>&);

GS_ISA_END
