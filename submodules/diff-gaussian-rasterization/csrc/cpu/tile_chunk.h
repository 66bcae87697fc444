#pragma once
// A tile of the image, and some of its splats, local to it.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "../data.h"
#include "../math/ray_pixels.h"
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

// Has the splats of instances fetched into the cache, for a chunk that is gathered later: they lie anywhere.
template <class T>
void prefetch_splats(const BlendInput<T>& in, int64_t begin, int64_t end) {
  for (int64_t k = begin; k < end; ++k) {
    const int row = splat_row(in.rays);
    const T* splat = in.splats + row * int64_t(in.instances[k]);
    __builtin_prefetch(splat), __builtin_prefetch(splat + row - 1);
  }
}

// What a chunk of splats on rays has besides.
template <class T, int kChunk, bool kRays>
struct ChunkOfRays {};
template <class T, int kChunk>
struct ChunkOfRays<T, kChunk, true> {
  alignas(64) T slope_u[kChunk], slope_v[kChunk], e[kChunk];
};

// The values of at most kChunk splats, an array each, as LocalSplat has them, or LocalRaySplat.
template <class T, int kChunk, bool kRays>
struct Chunk : ChunkOfRays<T, kChunk, kRays> {
  alignas(64) T y[kChunk], l11[kChunk], l12[kChunk], l22[kChunk], u[kChunk], log2_opacity[kChunk];
  alignas(64) T r[kChunk], g[kChunk], b[kChunk], inverse_depth[kChunk];
  alignas(64) T x[kChunk];  // the mean's, in the tile

  // The shapes of a vector of splats from k on; no colours.
  auto shapes(int64_t k) const {
    using S = Simd<T>;
    using V = typename S::Vec;
    std::conditional_t<kRays, LocalRaySplat<V>, LocalSplat<V>> s = {};
    s.y = S::load(y + k), s.l11 = S::load(l11 + k), s.l12 = S::load(l12 + k), s.l22 = S::load(l22 + k);
    s.u = S::load(u + k), s.log2_opacity = S::load(log2_opacity + k);
    if constexpr (kRays)
      s.slope_u = S::load(this->slope_u + k), s.slope_v = S::load(this->slope_v + k), s.e = S::load(this->e + k);
    return s;
  }

  void gather(const BlendInput<T>& in, const Tile& tile, int64_t begin, int64_t count) {
    for (int64_t k = 0; k < count; ++k) {
      SplatOf<T, kRays> splat;
      std::memcpy(&splat, in.splats + kSplatRow<kRays> * int64_t(in.instances[begin + k]), sizeof splat);
      const T left = unrolled(splat, T(tile.x), in.image.width);
      const auto s = localise(splat, left, T(tile.y));
      y[k] = s.y, l11[k] = s.l11, l12[k] = s.l12, l22[k] = s.l22, u[k] = s.u, log2_opacity[k] = s.log2_opacity;
      r[k] = s.r, g[k] = s.g, b[k] = s.b, inverse_depth[k] = s.inverse_depth;
      x[k] = splat.x - left;
      if constexpr (kRays) this->slope_u[k] = s.slope_u, this->slope_v[k] = s.slope_v, this->e[k] = s.e;
    }
  }
};

template <class T, class S = Simd<T>>
typename S::Vec lane_numbers(int first) {
  T x[S::kLanes];
  for (int i = 0; i < S::kLanes; ++i) x[i] = T(first + i);
  return S::load(x);
}

GS_ISA_END
