#pragma once
// The layout of a block that blends a tile. A warp owns a sub-tile and a lane several pixels of a row, so that they
// share a splat's loads, the loop and the ballot. 32 splats at a time are tested against the sub-tile, one by each
// lane.
#include <cuda_runtime.h>

#include "../data.h"
#include "../math/blend.h"
#include "../math/exp2.h"
#include "../math/footprint.h"
#include "../math/layers.h"
#include "../math/ray_pixels.h"
#include "queue.cuh"
#include "splat_row.cuh"

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

// What a batch of splats on rays has besides.
template <int kCount, bool kRays>
struct BatchOfRays {};
template <int kCount>
struct BatchOfRays<kCount, true> {
  float4 ray[kCount];  // slope_u, slope_v, e
};

// A batch of splats in shared memory, local to the tile.
template <int kCount, bool kRays>
struct Batch : BatchOfRays<kCount, kRays> {
  float4 shape[kCount];  // y, l11, l12, l22
  float4 rest[kCount];   // u, log2 opacity, x, inverse depth
  float4 color[kCount];  // r, g, b

  // from, top: of the tile.
  __device__ void put(int k, const BlendInput<float>& in, int32_t index, float from, float top) {
    const auto splat = load_splat<kRays>(in.splats, index);
    const float left = unrolled(splat, from, in.image.width);
    const auto s = localise(splat, left, top);
    shape[k] = make_float4(s.y, s.l11, s.l12, s.l22);
    rest[k] = make_float4(s.u, s.log2_opacity, splat.x - left, s.inverse_depth);
    color[k] = make_float4(s.r, s.g, s.b, 0);
    if constexpr (kRays) this->ray[k] = make_float4(s.slope_u, s.slope_v, s.e, 0);
  }

  __device__ auto local(int k) const {
    const float4 a = shape[k], b = rest[k];
    const LocalSplat<float> flat = {a.x, a.y, a.z, a.w, b.x, b.y, 0, 0, 0, b.w};
    if constexpr (kRays) {
      const float4 c = this->ray[k];
      return LocalRaySplat<float>{flat, c.x, c.y, c.z};
    } else {
      return flat;
    }
  }

  // Tells whether splat k can reach a box of the tile's pixels.
  __device__ bool reaches(int k, float x0, float x1, float y0, float y1) const {
    const float4 a = shape[k], b = rest[k];
    SplatOf<float, kRays> splat = {};
    splat.x = b.z, splat.y = a.x, splat.l11 = a.y, splat.l12 = a.z, splat.l22 = a.w, splat.log2_opacity = b.y;
    if constexpr (kRays) {
      const float4 c = this->ray[k];
      splat.slope_u = c.x, splat.slope_v = c.y, splat.e = c.z;
    }
    return box_reached(make_tile_test(splat, TileRect{0, 0, 1, 1}, 0, 0), x0, x1, y0, y1);
  }
};

template <class L, int kCount, bool kRays>
__device__ inline unsigned reached_by_warp(const Batch<kCount, kRays>& batch, const L& at, int from, int count) {
  const int k = from + threadIdx.x % 32;
  const bool hit = k < count && batch.reaches(k, at.left, at.left + L::kWide - 1, at.top, at.top + L::kHigh - 1);
  return __ballot_sync(kWarp, hit);
}

// Splats that a warp evaluates at once, going front to back. With one pixel a lane, a single splat would leave it idle.
template <class L>
constexpr int kTogether = L::kRun == 1 ? 2 : 1;

// Goes front to back through the splats that reach the warp, of 32 from `from`. Calls step(k, p, exponent) for each
// and for each pixel of the lane.
template <class L, int kCount, bool kRays, class Step>
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
      const auto row = row_terms(batch.local(k[i]), float(at.y));
#pragma unroll
      for (int p = 0; p < L::kRun; ++p) t[i][p] = exists ? exponent_at(row, float(at.x + at.column(p))) : -INFINITY;
    }
#pragma unroll
    for (int i = 0; i < kTogether<L>; ++i)
#pragma unroll
      for (int p = 0; p < L::kRun; ++p) step(k[i], p, t[i][p]);
  }
}

}  // namespace cuda
}  // namespace gs
