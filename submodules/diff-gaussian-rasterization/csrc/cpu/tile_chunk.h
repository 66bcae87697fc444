#pragma once
// A tile of the image, and some of its splats, local to it.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "../data.h"
#include "../math/lens_pixels.h"
#include "gs/simd.h"

GS_ISA_BEGIN

constexpr int kPixels = kTile * kTile;

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

// Calls visit(pixel of the tile, pixel of the image).
template <class Visit>
void each_pixel(Image image, const Tile& tile, const Visit& visit) {
  for (int r = 0; r < tile.rows; ++r)
    for (int c = 0; c < tile.columns; ++c) visit(r * kTile + c, int64_t(tile.y + r) * image.width + tile.x + c);
}

// Has the splats of instances fetched into the cache, for a chunk that is gathered later: they lie anywhere.
template <class T>
void prefetch_splats(const BlendInput<T>& in, int64_t begin, int64_t end) {
  for (int64_t k = begin; k < end; ++k) {
    const int row = splat_row(in.rays);
    const T* splat = in.splats + row * int64_t(in.instances[k]);
    __builtin_prefetch(splat), __builtin_prefetch(splat + row - 1);
  }
}

template <class T, class S = Simd<T>>
typename S::Vec lane_numbers(int first) {
  T x[S::kLanes];
  for (int i = 0; i < S::kLanes; ++i) x[i] = T(first + i);
  return S::load(x);
}

// What a chunk of splats on rays has besides.
template <class T, int kChunk, int kRays>
struct ChunkOfRays {};
template <class T, int kChunk>
struct ChunkOfRays<T, kChunk, kPinholeRays> {
  alignas(64) T slope_u[kChunk], slope_v[kChunk], e[kChunk];
};
template <class T, int kChunk>
struct ChunkOfRays<T, kChunk, kLensRays> : ChunkOfRays<T, kChunk, kPinholeRays> {
  alignas(64) T linear[9][kChunk];  // of LensTerms
};

// The places of a tile's pixels; of a lens with rays they come from its table.
template <class T, int kRays>
struct TilePlaces {
  TilePlaces() = default;
  TilePlaces(const BlendInput<T>&, int64_t, T* = nullptr) {}
  auto box(int, int) const { return 0; }
  auto from(int, int column) const { return lane_numbers<T>(column); }
};
template <class T>
struct TilePlaces<T, kLensRays> {
  alignas(64) T x[kPixels], y[kPixels];

  TilePlaces() = default;
  // Pixels that the lens does not show get an infinite threshold, and stay in the frame's middle.
  TilePlaces(const BlendInput<T>& in, int64_t tile, T* threshold = nullptr) {
    const T* from = places_of(in.table, in.image, tile);
    for (int p = 0; p < kPixels; ++p) {
      const bool shown = from[p] == from[p];
      x[p] = shown ? from[p] : T(0), y[p] = shown ? from[kPixels + p] : T(0);
      if (threshold && !shown) threshold[p] = std::numeric_limits<T>::infinity();
    }
  }

  // The limits of `count` pixels from `first` on.
  PlaceBox<T> box(int first, int count) const {
    const auto xs = std::minmax_element(x + first, x + first + count);
    const auto ys = std::minmax_element(y + first, y + first + count);
    return {*xs.first, *xs.second, *ys.first, *ys.second};
  }
  Place<typename Simd<T>::Vec> from(int at, int) const { return {Simd<T>::load(x + at), Simd<T>::load(y + at)}; }
};

// What splats show: a colour, a colour and an inverse depth, or channels, the first four of which stand in their place.
enum Payload : int { kColor, kColorAndDepth, kChannels };
constexpr int kLeading = 4;
template <int kPayload>
constexpr int kWidth = kPayload == kColor ? 3 : kLeading;  // of kLeading, what is there

// The values of at most kChunk splats, an array each, as LocalSplat has them, or LocalRaySplat.
template <class T, int kChunk, int kRays>
struct Chunk : ChunkOfRays<T, kChunk, kRays> {
  alignas(64) T y[kChunk], l11[kChunk], l12[kChunk], l22[kChunk], u[kChunk], log2_opacity[kChunk];
  alignas(64) T payload[kLeading][kChunk];
  alignas(64) T x[kChunk];  // the mean's, in the tile

  // The shapes of a vector of splats from k on; no colours.
  auto shapes(int64_t k) const {
    using S = Simd<T>;
    using V = typename S::Vec;
    std::conditional_t<kRays == kNoRays, LocalSplat<V>, LocalRaySplat<V>> s = {};
    s.y = S::load(y + k), s.l11 = S::load(l11 + k), s.l12 = S::load(l12 + k), s.l22 = S::load(l22 + k);
    s.u = S::load(u + k), s.log2_opacity = S::load(log2_opacity + k);
    if constexpr (kRays != kNoRays)
      s.slope_u = S::load(this->slope_u + k), s.slope_v = S::load(this->slope_v + k), s.e = S::load(this->e + k);
    return s;
  }

  // The terms of a splat on a lens's rays, or of a vector of them.
  template <class V>
  LensTerms<V> terms(int64_t k) const {
    const auto at = [&](const T* values) {
      V v;
      std::memcpy(&v, values + k, sizeof v);
      return v;
    };
    const auto of = [&](int first) {
      return Linear<V>{at(this->linear[first]), at(this->linear[first + 1]), at(this->linear[first + 2])};
    };
    return {of(0), of(3), of(6), at(this->e), at(log2_opacity), at(this->slope_u), at(this->slope_v)};
  }

  void gather(const BlendInput<T>& in, const Tile& tile, int64_t index, int64_t begin, int64_t count) {
    for (int64_t k = 0; k < count; ++k) {
      SplatOf<T, kRays> splat;
      std::memcpy(&splat, in.splats + kSplatRow<kRays> * int64_t(in.instances[begin + k]), sizeof splat);
      if constexpr (kRays == kLensRays) {
        TileFrame<T> frame;
        std::memcpy(&frame, in.table + kFrameValues * index, sizeof frame);
        const LensTerms<T> t = lens_terms(splat, frame);
        const T all[] = {t.u.one, t.u.x, t.u.y, t.v.one, t.v.x, t.v.y, t.s.one, t.s.x, t.s.y};
        for (int i = 0; i < 9; ++i) this->linear[i][k] = all[i];
        l12[k] = splat.l12, l22[k] = splat.l22, log2_opacity[k] = splat.log2_opacity;
        put_payload(k, in, in.instances[begin + k], splat);
        this->slope_u[k] = splat.slope_u, this->slope_v[k] = splat.slope_v, this->e[k] = splat.e;
        continue;
      }
      const T left = unrolled(splat, T(tile.x), in.image.width);
      const auto s = localise(splat, left, T(tile.y));
      y[k] = s.y, l11[k] = s.l11, l12[k] = s.l12, l22[k] = s.l22, u[k] = s.u, log2_opacity[k] = s.log2_opacity;
      put_payload(k, in, in.instances[begin + k], splat);
      x[k] = splat.x - left;
      if constexpr (kRays != kNoRays) this->slope_u[k] = s.slope_u, this->slope_v[k] = s.slope_v, this->e[k] = s.e;
    }
  }

 private:
  void put_payload(int64_t k, const BlendInput<T>& in, int64_t index, const Splat<T>& splat) {
    const T color[] = {splat.r, splat.g, splat.b, splat.inverse_depth};
    const int64_t channels = in.channels.count;
    for (int c = 0; c < kLeading; ++c)
      payload[c][k] = !channels ? color[c] : c < channels ? in.channels.of(index)[c] : T(0);
  }
};

GS_ISA_END
