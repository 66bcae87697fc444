#pragma once
// Blending, and the decisive splats, of tiles. A thread takes a tile, a vector takes pixels of one of its rows.
#include <limits>

#include "../backend.h"
#include "../math/exp2.h"
#include "further_channels.h"

GS_ISA_BEGIN

namespace {

constexpr int kChunkWords = kChunk / 64;

// A splat's RowTerms or RayRow of a row, from arrays of a chunk's splats.
template <class T, int kRays>
struct Rows {
  alignas(64) T top[kChunk], u0[kChunk];
  void store(int64_t k, const RowTerms<typename Simd<T>::Vec>& terms) {
    Simd<T>::store(top + k, terms.top), Simd<T>::store(u0 + k, terms.u0);
  }
  RowTerms<T> of(const Chunk<T, kChunk, kNoRays>& chunk, int k) const { return {top[k], chunk.l11[k], u0[k], T(0)}; }
};
template <class T>
struct Rows<T, kPinholeRays> {
  alignas(64) T v[kChunk], u0[kChunk];
  void store(int64_t k, const RayRow<typename Simd<T>::Vec>& terms) {
    Simd<T>::store(v + k, terms.flat.v), Simd<T>::store(u0 + k, terms.flat.u0);
  }
  RayRow<T> of(const Chunk<T, kChunk, kPinholeRays>& chunk, int k) const {
    return ray_row<T>({chunk.log2_opacity[k], chunk.l11[k], u0[k], v[k]}, chunk.slope_u[k], chunk.slope_v[k],
                      chunk.e[k]);
  }
};

template <class T>
struct Rows<T, kLensRays> {
  LensTerms<T> of(const Chunk<T, kChunk, kLensRays>& chunk, int k) const { return chunk.template terms<T>(k); }
};

// A strip is a vector's part of a tile's row. What it needs of a chunk's splats: their rows, and a bit for each
// that may reach it. Trained splats reach few rows, so testing a vector of splats at a time is most of the saving.
template <class T, int kRays>
struct Strip : Rows<T, kRays> {
  const TilePlaces<T, kRays>& places;
  int row, first;  // first: column
  uint64_t reached[kChunkWords];

  Strip(const Chunk<T, kChunk, kRays>& chunk, int64_t count, const TilePlaces<T, kRays>& places, int row, int first)
      : places(places), row(row), first(first), reached() {
    using S = Simd<T>;
    const auto box = places.box(at(), S::kLanes);
    for (int64_t k = 0; k < count; k += S::kLanes) {
      uint64_t bits;
      if constexpr (kRays == kLensRays) {
        bits = S::bits(box_reached(chunk.template terms<typename S::Vec>(k), box));
      } else {
        const auto terms = row_terms(chunk.shapes(k), T(row));
        this->store(k, terms);
        bits = S::bits(row_reached(terms, T(first), T(first + Simd<T>::kLanes - 1)));
      }
      if (count - k < S::kLanes) bits &= (uint64_t(1) << (count - k)) - 1;
      reached[k / 64] |= bits << k % 64;
    }
  }

  int at() const { return row * kTile + first; }

  // Calls splat(k, terms) for each splat that may reach the strip, front to back, until that returns false.
  template <class Body>
  void each(const Chunk<T, kChunk, kRays>& chunk, const Body& splat) const {
    for (int w = 0; w < kChunkWords; ++w)
      for (uint64_t bits = reached[w]; bits; bits &= bits - 1) {
        const int k = 64 * w + __builtin_ctzll(bits);
        if (!splat(k, this->of(chunk, k))) return;
      }
  }
};

// The state of a tile's pixels between two chunks.
template <class T>
struct ForwardState {
  alignas(64) T transmittance[kPixels], payload[kLeading][kPixels];
  alignas(64) T threshold[kPixels];  // log2 alpha that a splat must reach; infinite once the pixel has ended
  alignas(64) typename IntOf<T>::type last[kPixels];
};

// Calls add(k, weight) for the splats of a chunk that a strip blends. position: of the chunk's first splat in the
// tile's list. Returns false once all of the strip's pixels have ended.
template <class T, bool kLast, int kRays, class Add>
__attribute__((always_inline)) inline bool blend_weights(const Chunk<T, kChunk, kRays>& chunk,
                                                         const Strip<T, kRays>& strip, int64_t position, T cap,
                                                         ForwardState<T>& state, const Add& add) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  const int at = strip.at();
  const T least_left = T(kMinTransmittance);
  const auto x = strip.places.from(strip.at(), strip.first);
  const V zero = {}, never = zero + std::numeric_limits<T>::infinity();
  V left = S::load(state.transmittance + at), threshold = S::load(state.threshold + at);
  M last = {};
  if (kLast) std::memcpy(&last, state.last + at, sizeof last);
  bool open = true;
  strip.each(chunk, [&](int k, const auto& terms) {
    const V t = exponent_at(terms, x);
    M reached = t >= threshold;
    if (!S::any(reached)) return true;
    const V alpha = capped<V, T>(exp2_lanes<V, M>(reached ? t : zero, T()), cap);
    const V after = left - alpha * left;
    const M ends = reached & (after < least_left);
    if (S::any(ends)) {
      threshold = ends ? never : threshold;
      reached &= ~ends;
      open = S::any(threshold < never);
    }
    add(k, V(reached ? alpha * left : zero));
    if (kLast) last = reached ? M{} + typename S::Int(position + k + 1) : last;
    left = reached ? after : left;
    return open;
  });
  S::store(state.transmittance + at, left), S::store(state.threshold + at, threshold);
  if (kLast) std::memcpy(state.last + at, &last, sizeof last);
  return open;
}

// Blends a chunk into a strip, as above.
template <class T, int kPayload, bool kLast, int kRays>
bool blend_strip(const Chunk<T, kChunk, kRays>& chunk, const Strip<T, kRays>& strip, int64_t position,
                 ForwardState<T>& state, FurtherPlanes<T, kPayload>& further) {
  using S = Simd<T>;
  using V = typename S::Vec;
  const int at = strip.at();
  V sums[kWidth<kPayload>];
  for (int c = 0; c < kWidth<kPayload>; ++c) sums[c] = S::load(state.payload[c] + at);
  const bool open = blend_weights<T, kLast>(chunk, strip, position, further.cap(), state, [&](int k, V weight) {
    for (int c = 0; c < kWidth<kPayload>; ++c) sums[c] = S::multiply_add(weight, S::all(chunk.payload[c][k]), sums[c]);
    if constexpr (kPayload == kChannels) further.weigh(position + k, weight);
  });
  if constexpr (kPayload == kChannels)
    further.store(0, sums, state.payload[0] + at), further.add(at);
  else
    for (int c = 0; c < kWidth<kPayload>; ++c) S::store(state.payload[c] + at, sums[c]);
  return open;
}

// Goes through a tile's list front to back, a chunk at a time, for each strip of its pixels. body(chunk, strip,
// position of the chunk in the list) tells whether a pixel of the strip is still open. Pixels outside the image never
// are.
template <class T, int kRays, class Body>
void through_tile(const BlendInput<T>& in, const Tile& tile, int64_t index, T* threshold, const Body& body) {
  constexpr int kStrips = kTile / Simd<T>::kLanes;
  for (int p = 0; p < kPixels; ++p)
    threshold[p] = p % kTile < tile.columns ? T(kLog2MinAlpha) : std::numeric_limits<T>::infinity();
  const TilePlaces<T, kRays> places(in, index, threshold);
  Chunk<T, kChunk, kRays> chunk;
  const int64_t begin = in.ranges[index], end = in.ranges[index + 1];
  const int open_strips = (tile.columns - 1) / Simd<T>::kLanes + 1;
  bool open[kPixels / Simd<T>::kLanes] = {};
  for (int s = 0; s < tile.rows * kStrips; ++s) open[s] = s % kStrips < open_strips;
  bool any = true;
  for (int64_t from = begin; any && from < end; from += kChunk) {
    const int64_t count = std::min<int64_t>(kChunk, end - from);
    chunk.gather(in, tile, index, from, count);
    prefetch_splats(in, from + count, std::min(end, from + count + kChunk));
    any = false;
    for (int s = 0; s < tile.rows * kStrips; ++s) {
      if (!open[s]) continue;
      const Strip<T, kRays> strip(chunk, count, places, s / kStrips, s % kStrips * Simd<T>::kLanes);
      any |= open[s] = body(chunk, strip, from - begin);
    }
  }
}

template <class T, int kPayload, bool kLast, int kRays>
void blend_tile(const BlendInput<T>& in, int64_t index, const Blended<T>& out) {
  const Tile tile(index, in.image);
  ForwardState<T> state;
  FurtherPlanes<T, kPayload> further(in, index);
  std::fill_n(state.transmittance, kPixels, T(1));
  std::fill_n(state.payload[0], kWidth<kPayload> * kPixels, T(0));
  if (kLast) std::fill_n(state.last, kPixels, 0);
  through_tile<T, kRays>(in, tile, index, state.threshold,
                         [&](const auto& chunk, const Strip<T, kRays>& strip, int64_t position) {
                           return blend_strip<T, kPayload, kLast>(chunk, strip, position, state, further);
                         });
  for (int64_t c = 0; c < in.planes(); ++c) {
    T* plane = c < kLeading ? state.payload[c] : further.plane(c);
    for (int p = 0; p < kPixels; ++p) plane[p] += state.transmittance[p] * in.background[c];
    if (kPayload == kChannels)
      each_pixel(in.image, tile, [&](int from, int64_t to) {
        out.color[c * in.channels.plane + in.channels.pixel * to] = plane[from];
      });
    else
      write_tile(plane, in.image, tile, out.color + c * in.image.width * in.image.height);
  }
  if (kPayload == kChannels && out.alpha)
    each_pixel(in.image, tile, [&](int from, int64_t to) { out.alpha[to] = 1 - state.transmittance[from]; });
  write_tile(state.transmittance, in.image, tile, out.transmittance);
  if (kPayload == kColorAndDepth) write_tile(state.payload[3], in.image, tile, out.inverse_depth);
  if (kLast) write_tile(state.last, in.image, tile, out.last);
}

// Marks the splats of a chunk that are decisive for a strip: a pixel blends splats up to its `last`, and the next splat
// that reaches the pixel ends it. Returns false once all the strip's pixels have ended. instances: the chunk's.
template <class T, int kRays>
bool mark_strip(const Chunk<T, kChunk, kRays>& chunk, const Strip<T, kRays>& strip, const int32_t* instances,
                int64_t position, const typename IntOf<T>::type* last_of_tile, T* threshold_of_tile, bool* decisive) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  const int at = strip.at();
  const auto x = strip.places.from(strip.at(), strip.first);
  const V never = V{} + std::numeric_limits<T>::infinity();
  V threshold = S::load(threshold_of_tile + at);
  M last;
  std::memcpy(&last, last_of_tile + at, sizeof last);
  bool open = true;
  strip.each(chunk, [&](int k, const auto& terms) {
    const M reached = exponent_at(terms, x) >= threshold;
    if (!S::any(reached)) return true;
    __atomic_store_n(decisive + instances[k], true, __ATOMIC_RELAXED);
    threshold = (reached & (last <= typename S::Int(position + k))) ? never : threshold;
    return open = S::any(threshold < never);
  });
  S::store(threshold_of_tile + at, threshold);
  return open;
}

template <class T, int kRays>
void mark_tile(const BlendInput<T>& in, const int32_t* last_plane, int64_t index, bool* decisive) {
  const Tile tile(index, in.image);
  alignas(64) T threshold[kPixels];
  alignas(64) typename IntOf<T>::type last[kPixels] = {};
  read_tile(last_plane, in.image, tile, last);
  const int32_t* instances = in.instances + in.ranges[index];
  through_tile<T, kRays>(in, tile, index, threshold,
                         [&](const auto& chunk, const Strip<T, kRays>& strip, int64_t position) {
                           return mark_strip(chunk, strip, instances + position, position, last, threshold, decisive);
                         });
}

template <class T, int kRays>
void blend_tiles(const Executor& executor, const BlendInput<T>& in, const Blended<T>& out) {
  auto run = out.inverse_depth
                 ? (out.last ? blend_tile<T, kColorAndDepth, true, kRays> : blend_tile<T, kColorAndDepth, false, kRays>)
                 : (out.last ? blend_tile<T, kColor, true, kRays> : blend_tile<T, kColor, false, kRays>);
  if constexpr (kRays != kLensRays)
    if (in.channels.count) run = blend_tile<T, kChannels, true, kRays>;
  const int64_t tiles = tiles_of(in.image);
  for_dynamic(executor, tiles, 1, [&](int64_t tile, int64_t) { run(in, tile, out); });
}

}  // namespace

// In files of their own, as project_on_rays.
template <class T>
void blend_lens_rays(const Executor&, const BlendInput<T>&, const Blended<T>&);
template <class T>
void mark_lens_rays(const Executor&, const BlendInput<T>&, const int32_t* last, bool* decisive);

GS_ISA_END
