#pragma once
// The layout of a block that blends a tile. A warp owns a sub-tile and a lane several pixels of a row, so that they
// share a splat's loads, the loop and the ballot. 32 splats at a time are tested against the sub-tile, one by each
// lane.
#include <cuda_runtime.h>

#include "cuda/project/splat_row.cuh"
#include "cuda/queue/queue.cuh"
#include "data.h"
#include "math/blend.h"
#include "math/exp2.h"
#include "math/footprint.h"
#include "math/layers.h"
#include "math/lens_pixels.h"

namespace gs {
namespace cuda {

using namespace baseline;

constexpr float kLeast = float(kLog2MinAlpha);

// The share of a lane is kRun pixels of one row, 4 columns apart.
template <int kRun_>
struct Layout {
  static constexpr int kRun = kRun_;
  static constexpr int kColumns = kRun == 1 ? 8 : 4;  // lanes side by side
  static constexpr int kWide = kColumns * kRun, kHigh = 32 / kColumns;
  static constexpr int kAcross = kTile / kWide, kWarps = kTile * kTile / (kWide * kHigh);
  static constexpr int kThreads = 32 * kWarps;

  int left, top;  // of the warp's sub-tile, in the tile
  int x, y;       // of the lane's first pixel, in the tile
  __device__ Layout() {
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    left = warp % kAcross * kWide, top = warp / kAcross * kHigh;
    x = left + lane % kColumns, y = top + lane / kColumns;
  }
  __device__ static int column(int run) { return run * kColumns; }
};

// The same, and where the lane's pixels are: their columns, or on a lens's rays their places, and the limits of the
// warp's, from the lens's table. What the lens does not show is no number, and reached by nothing.
template <class L, int kRays>
struct PlacesOf : L {
  __device__ PlacesOf(const BlendInput<float>&, int) {}
  __device__ float place(int p) const { return float(this->x + this->column(p)); }
};
template <class L>
struct PlacesOf<L, kLensRays> : L {
  float px[L::kRun], py[L::kRun];
  PlaceBox<float> box;

  __device__ PlacesOf(const BlendInput<float>& in, int tile) {
    const float* from = places_of(in.table, in.image, tile) + kTile * this->y + this->x;
    float least_x = INFINITY, most_x = -INFINITY, least_y = INFINITY, most_y = -INFINITY;
    for (int p = 0; p < L::kRun; ++p) {
      px[p] = from[this->column(p)], py[p] = from[kTile * kTile + this->column(p)];
      least_x = fminf(least_x, px[p]), most_x = fmaxf(most_x, px[p]);
      least_y = fminf(least_y, py[p]), most_y = fmaxf(most_y, py[p]);
    }
    for (int step = 16; step; step /= 2) {
      least_x = fminf(least_x, __shfl_xor_sync(kWarp, least_x, step));
      most_x = fmaxf(most_x, __shfl_xor_sync(kWarp, most_x, step));
      least_y = fminf(least_y, __shfl_xor_sync(kWarp, least_y, step));
      most_y = fmaxf(most_y, __shfl_xor_sync(kWarp, most_y, step));
    }
    box = {least_x, most_x, least_y, most_y};
  }
  __device__ Place<float> place(int p) const { return {px[p], py[p]}; }
};

// What a batch of splats on rays has besides.
template <int kCount, int kRays>
struct BatchOfRays {};
template <int kCount>
struct BatchOfRays<kCount, kPinholeRays> {
  float4 ray[kCount];  // slope_u, slope_v, e
};

// A batch of splats in shared memory, local to the tile.
template <int kCount, int kRays>
struct Batch : BatchOfRays<kCount, kRays> {
  float4 shape[kCount];  // y, l11, l12, l22
  float4 rest[kCount];   // u, log2 opacity, x, inverse depth
  float4 color[kCount];  // r, g, b

  // from, top: of the tile.
  __device__ void put(int k, const BlendInput<float>& in, int, int32_t index, float from, float top) {
    const auto splat = load_splat<kRays>(in.splats, index);
    const float left = unrolled(splat, from, in.image.width);
    const auto s = localise(splat, left, top);
    shape[k] = make_float4(s.y, s.l11, s.l12, s.l22);
    rest[k] = make_float4(s.u, s.log2_opacity, splat.x - left, s.inverse_depth);
    color[k] = make_float4(s.r, s.g, s.b, 0);
    if constexpr (kRays != kNoRays) this->ray[k] = make_float4(s.slope_u, s.slope_v, s.e, 0);
  }

  __device__ auto local(int k) const {
    const float4 a = shape[k], b = rest[k];
    const LocalSplat<float> flat = {a.x, a.y, a.z, a.w, b.x, b.y, 0, 0, 0, b.w};
    if constexpr (kRays != kNoRays) {
      const float4 c = this->ray[k];
      return LocalRaySplat<float>{flat, c.x, c.y, c.z};
    } else {
      return flat;
    }
  }

  template <class L>
  __device__ auto terms(int k, const L& at) const {
    return row_terms(local(k), float(at.y));
  }

  // Tells whether splat k can reach the warp's pixels.
  template <class L>
  __device__ bool reaches(int k, const L& at) const {
    const float4 a = shape[k], b = rest[k];
    SplatOf<float, kRays> splat = {};
    splat.x = b.z, splat.y = a.x, splat.l11 = a.y, splat.l12 = a.z, splat.l22 = a.w, splat.log2_opacity = b.y;
    if constexpr (kRays != kNoRays) {
      const float4 c = this->ray[k];
      splat.slope_u = c.x, splat.slope_v = c.y, splat.e = c.z;
    }
    return box_reached(make_tile_test(splat, TileRect{0, 0, 1, 1}, 0, 0), float(at.left), float(at.left + L::kWide - 1),
                       float(at.top), float(at.top + L::kHigh - 1));
  }
};

// A splat on the rays of a lens, in a tile.
struct LensLocal {
  LensTerms<float> terms;
  float l12, l22, inverse_depth;
};

template <int kCount>
struct Batch<kCount, kLensRays> {
  float4 u[kCount], v[kCount];  // and e; and log2 opacity
  float4 rest[kCount];          // s, inverse depth
  float4 color[kCount];         // r, g, b
  float4 shape[kCount];         // slope_u, slope_v, l12, l22

  __device__ void put(int k, const BlendInput<float>& in, int tile, int32_t index, float, float) {
    const auto s = load_splat<kLensRays>(in.splats, index);
    const LensTerms<float> t = lens_terms(s, frame_at(in.table, tile));
    u[k] = make_float4(t.u.one, t.u.x, t.u.y, t.e), v[k] = make_float4(t.v.one, t.v.x, t.v.y, t.log2_opacity);
    rest[k] = make_float4(t.s.one, t.s.x, t.s.y, s.inverse_depth);
    color[k] = make_float4(s.r, s.g, s.b, 0), shape[k] = make_float4(s.slope_u, s.slope_v, s.l12, s.l22);
  }

  // Of no slopes.
  template <class L>
  __device__ LensTerms<float> terms(int k, const L&) const {
    const float4 a = u[k], b = v[k], c = rest[k];
    return {{a.x, a.y, a.z}, {b.x, b.y, b.z}, {c.x, c.y, c.z}, a.w, b.w, 0, 0};
  }
  __device__ LensLocal local(int k) const {
    LensLocal s = {terms(k, 0), shape[k].z, shape[k].w, rest[k].w};
    s.terms.slope_u = shape[k].x, s.terms.slope_v = shape[k].y;
    return s;
  }
  template <class L>
  __device__ bool reaches(int k, const L& at) const {
    return box_reached(terms(k, 0), at.box);
  }
};

template <class L, int kCount, int kRays>
__device__ inline unsigned reached_by_warp(const Batch<kCount, kRays>& batch, const L& at, int from, int count) {
  const int k = from + threadIdx.x % 32;
  const bool hit = k < count && batch.reaches(k, at);
  return __ballot_sync(kWarp, hit);
}

// Splats that a warp evaluates at once, going front to back. With one pixel a lane, a single splat would leave it idle.
template <class L>
constexpr int kTogether = L::kRun == 1 ? 2 : 1;

// Goes front to back through the splats that reach the warp, of 32 from `from`. Calls step(k, exponents) for each, with
// those of the lane's pixels.
template <class L, int kCount, int kRays, class Step>
__device__ __forceinline__ void front_to_back(const Batch<kCount, kRays>& batch, const L& at, int from, int count,
                                              const Step& step) {
  for (unsigned hits = reached_by_warp(batch, at, from, count); hits;) {
    int k[kTogether<L>];
    float t[kTogether<L>][L::kRun];
#pragma unroll
    for (int i = 0; i < kTogether<L>; ++i) {
      const bool exists = i == 0 || hits;
      k[i] = exists ? from + __ffs(hits) - 1 : k[0];
      hits &= hits - 1;
      const auto row = batch.terms(k[i], at);
#pragma unroll
      for (int p = 0; p < L::kRun; ++p) t[i][p] = exists ? exponent_at(row, at.place(p)) : -INFINITY;
    }
#pragma unroll
    for (int i = 0; i < kTogether<L>; ++i) step(k[i], t[i]);
  }
}

}  // namespace cuda
}  // namespace gs
