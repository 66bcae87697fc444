// The backward of blending many channels, a pass after the other: geometry's sums in rows to which each pass adds, and
// the sums of the pass's channels in rows of their own.
#include "blend_vjp_tiles.h"

GS_ISA_BEGIN

namespace {

// Geometry's sums: moments, those of rays, and those of absolute gradients.
template <int kRays, bool kAbsolute>
constexpr int kShapes = 6 + (kRays ? kRayValues : 0) + (kAbsolute ? kAbsoluteValues : 0);

// The image's gradients at a tile's pixels, in the order of BackwardState's.
template <class T>
using Planes = T[kMostChannels][kPixels];

// A vector of a tile's pixels that a splat reaches, and its weights there.
template <class T>
struct Reached {
  typename Simd<T>::Vec weight;
  int at;
};

// Calls body(row, column) for the vectors of pixels that splat k may reach.
template <class T, int kRays, class Body>
void each_vector(const Batch<T, kRays>& batch, int k, const Body& body) {
  constexpr int kParts = RowTable<T, kRays>::kParts;
  const int first = batch.columns.first[k], wide = batch.columns.last[k] - first;
  const auto rows = [&](uint32_t bits, int begin, int end) {
    for (; bits; bits &= bits - 1)
      for (int column = begin; column < end; column += kColumns<T>) body(__builtin_ctz(bits), column);
  };
  if (wide < kColumns<T>) {  // one vector a row, which may begin at any column
    const int begin = std::min(first, kTile - kColumns<T>);
    rows(batch.table.rows(k), begin, begin + 1);
  } else if (kParts == 1) {
    const int vectors = wide / kColumns<T> + 1, begin = std::min(first, kTile - vectors * kColumns<T>);
    rows(batch.table.rows(k), begin, begin + vectors * kColumns<T>);
  } else {
    for (int p = 0; p < kParts; ++p) rows(batch.table.rows(k, p), p * kColumns<T>, p * kColumns<T> + 1);
  }
}

// Sums one splat's values over its pixels: geometry's, and those of the channels. values: the splat's.
template <class T, int kRays, bool kAbsolute>
void splat_sums(const Batch<T, kRays>& batch, int k, int64_t position, const Channels<T>& channels, const T* values,
                const Planes<T>& planes, BackwardState<T, kRays>& state, T* shapes, T* of_channels) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  const Chunk<T, kBatch, kRays>& chunk = batch.chunk;
  const V zero = {};
  PixelSums<T, kRays, kAbsolute> m;
  Reached<T> reached[kPixels / S::kLanes + kTile];
  int count = 0;
  each_vector(batch, k, [&](int row, int column) {
    const auto terms = batch.table.of(chunk, row, k);
    const int at = place<T>(row, column);
    M last;
    std::memcpy(&last, state.last + at, sizeof last);
    const auto pixel = at_pixel(terms, pixels_at(state, at, column));
    const V t = row_exponent(terms, pixel);
    const M hit = (t >= T(kLog2MinAlpha)) & (last > typename S::Int(position));
    if (!S::any(hit)) return;
    const V uncapped = hit ? exp2_lanes<V, M>(hit ? t : zero, T()) : zero;
    const V alpha = capped<V, T>(uncapped, channels.cap);
    V left = S::load(state.transmittance + at), behind = S::load(state.behind + at), value = zero;
    for (int64_t c = 0; c < channels.count; ++c) value += values[c] * S::load(planes[c] + at);
    V q = uncapped * alpha_gradient<T, V>(alpha, value, left, behind);
    if (channels.stops) q = uncapped > channels.cap ? zero : q;
    S::store(state.transmittance + at, left), S::store(state.behind + at, behind);
    m.add(chunk, k, terms, pixel, q);
    reached[count++] = {alpha * left, at};
  });
  constexpr int kOwn = kShapes<kRays, kAbsolute>;
  V sums[kOwn];
  if constexpr (kRays != kNoRays) {
    const V all[] = {m.q, m.u, m.v, m.uu, m.uv, m.vv, m.pu, m.pv, m.pp, zero, m.absolute_u, m.absolute_uv};
    std::copy_n(all, kOwn, sums);
  } else {
    const V all[] = {m.q, m.u, m.v, m.uu, m.uv, m.vv, m.absolute_u, m.absolute_uv};
    std::copy_n(all, kOwn, sums);
  }
  LaneSums<T, int(sizeof sums[0])>::store(sums, shapes);
  constexpr int kGroup = 8;
  for (int64_t first = 0; first < channels.count; first += kGroup) {  // planes beyond the last one are zero
    V shown[kGroup] = {};
    for (int i = 0; i < count; ++i)
      for (int c = 0; c < kGroup; ++c) shown[c] += reached[i].weight * S::load(planes[first + c] + reached[i].at);
    LaneSums<T, int(sizeof shown[0])>::store(shown, of_channels + first);
  }
}

// The rows of a pass. adds: whether `shapes` has sums of other passes.
template <class T, int kRow>
struct PassRows {
  const GradientRows<T, kRow>& shapes;
  T* channels;  // (rows, kMostChannels), or null
  bool adds;
};

template <class T, int kRays, bool kAbsolute, int kRow>
void channels_of_tile_vjp(const BlendInput<T>& in, const Channels<T>& channels, const BlendGradient<T>& g,
                          int64_t index, int64_t processed, const PassRows<T, kRow>& rows) {
  constexpr int kOwn = kShapes<kRays, kAbsolute>, kColors = kRow - kOwn;  // after the moments
  const Tile tile(index, in.image);
  const int64_t begin = in.ranges[index], plane = int64_t(in.image.width) * in.image.height;
  BackwardState<T, kRays> state;
  alignas(64) Planes<T> planes = {};
  std::fill_n(state.behind, kPixels, T(0));
  if (g.transmittance_gradient) read_tile(g.transmittance_gradient, in.image, tile, state.behind);
  for (int64_t c = 0; c < channels.count; ++c) {
    read_tile(g.color + c * plane, in.image, tile, planes[c]);
    for (int p = 0; p < kPixels; ++p) state.behind[p] += in.background[c] * planes[c][p];
    interleave<T>(planes[c]);
  }
  interleave<T>(state.behind);
  read_ends(in, g, tile, index, state);
  Batch<T, kRays> batch;
  for (int64_t to = processed; to > 0; to -= std::min<int64_t>(kBatch, to)) {
    const int64_t from = std::max<int64_t>(0, to - kBatch), count = to - from;
    batch.chunk.gather(in, tile, index, begin + from, count);
    batch.columns.find(batch.chunk, count, state.places);
    batch.table.fill(batch.chunk, count, from, state);
    for (int64_t position = to - 1; position >= from; --position) {
      const int32_t splat = in.instances[begin + position];
      const int64_t slot = slot_of(g.slots, splat, tile.x / kTile, tile.y / kTile);
      T shapes[kOwn], shown[kMostChannels], *row = rows.shapes.row(slot);
      splat_sums<T, kRays, kAbsolute>(batch, int(position - from), position, channels,
                                      channels.values + channels.stride * splat, planes, state, shapes, shown);
      for (int v = 0; v < kOwn; ++v) {
        T& sum = row[v < 6 ? v : v + kColors];
        sum = rows.adds ? sum + shapes[v] : shapes[v];
      }
      if (!rows.adds)
        for (int c = 0; c < kColors; ++c) row[6 + c] = c < 3 && c < channels.count ? shown[c] : 0;
      if (rows.channels) std::copy_n(shown, channels.count, rows.channels + kMostChannels * rows.shapes.number(slot));
    }
  }
}

template <class T, int kRays, bool kAbsolute>
void run_passes(const Executor& executor, const BlendInput<T>& in, const Channels<T>& channels,
                const BlendGradient<T>& g, const RowMemory<T>& memory, T* values) {
  constexpr int kRow = kSums<kRays, kAbsolute>;
  GradientRows<T, kRow> shapes(g.slot_count);
  const std::vector<int32_t> processed = mark_rows(executor, in, g, shapes);
  std::unique_ptr<T[]> of_channels;
  shapes.allocate([&](int64_t count) {
    if (values) of_channels.reset(new T[kMostChannels * count]);
    return memory.take(memory.context, count);
  });
  const auto first_row = [&](int64_t splat) { return shapes.number(g.slots[splat].first); };
  each_pass(channels, in, [&](int64_t first, const Channels<T>& pass, const BlendInput<T>& own, int64_t plane) {
    BlendGradient<T> gradient = g;
    gradient.color += plane;
    if (first > 0) gradient.transmittance_gradient = nullptr;
    const PassRows<T, kRow> rows{shapes, of_channels.get(), first > 0};
    for_dynamic(executor, tiles_of(in.image), 1, [&](int64_t tile, int64_t) {
      channels_of_tile_vjp<T, kRays, kAbsolute>(own, pass, gradient, tile, processed[tile], rows);
    });
    if (!values) return;
    for_dynamic(executor, g.count, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        double sums[kMostChannels] = {};  // a splat may have thousands of tiles
        for (int64_t row = first_row(i); row < first_row(i + 1); ++row)
          for (int64_t c = 0; c < pass.count; ++c) sums[c] += of_channels[kMostChannels * row + c];
        std::copy_n(sums, pass.count, values + channels.stride * i + first);
      }
    });
  });
  for_dynamic(executor, g.count, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) memory.counts[i] = int32_t(first_row(i + 1) - first_row(i));
  });
}

}  // namespace

template <class T>
void channel_rows(const Executor& executor, const BlendInput<T>& in, const Channels<T>& channels,
                  const BlendGradient<T>& g, const RowMemory<T>& memory, T* values) {
  const auto run = in.rays ? (memory.absolute ? run_passes<T, kPinholeRays, true> : run_passes<T, kPinholeRays, false>)
                           : (memory.absolute ? run_passes<T, kNoRays, true> : run_passes<T, kNoRays, false>);
  run(executor, in, channels, g, memory, values);
}

#define GS_INSTANTIATE(T)                                                                                           \
  template void channel_rows<T>(const Executor&, const BlendInput<T>&, const Channels<T>&, const BlendGradient<T>&, \
                                const RowMemory<T>&, T*);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
