#pragma once
// What a splat's gradient sums over the pixels of a lane, and over those of a warp.
#include <type_traits>

#include "cuda/blend/blend_layout.cuh"

namespace gs {
namespace cuda {

// Sums over a lane's pixels, which lie in one row. Along it v is constant, so three of the moments come last.
struct FlatRowSums {
  float q = 0, qu = 0, quu = 0;

  __device__ void add(float u, float q_here) {
    const float qu_here = q_here * u;
    q += q_here, qu += qu_here, quu += qu_here * u;
  }
  __device__ Moments<float> moments(const RowTerms<float>& row) const {
    return {q, qu, row.v * q, quu, row.v * qu, row.v * row.v * q};
  }
};

// Of a lane's pixels, on the rays of a lens.
struct LensRowSums : PlaceSums<float> {
  using PlaceSums<float>::moments;
  __device__ RayMoments<float> moments(const LensTerms<float>&, const LensLocal&) const { return moments(); }
};
struct RayRowMoments : RayRowSums<float> {
  using RayRowSums<float>::moments;
  __device__ RayMoments<float> moments(const RayRow<float>& row, const LocalRaySplat<float>& splat) const {
    return moments(row, splat.slope_v);
  }
};
template <class Sums, class Row, class Here>
__device__ __forceinline__ void add_pixel(Sums& sums, const Row&, const Here& here, float q) {
  sums.add(here, q);
}
__device__ __forceinline__ void add_pixel(LensRowSums& sums, const LensTerms<float>& terms, const AtPlace<float>& here,
                                          float q) {
  sums.add(terms, here, q);
}

// What moves the mean, whitened: u and v, or w a / s.
__device__ inline float2 pull(const LocalSplat<float>&, const RowTerms<float>& row, float u) { return {u, row.v}; }
__device__ inline float2 pull(const LocalRaySplat<float>& splat, const RayRow<float>& row, const AtPixel<float>& at) {
  const RayWeights<float> weights = ray_weights(row, at, splat.slope_v);
  return {weights.au, weights.av};
}

__device__ inline float2 pull(const LensLocal&, const LensTerms<float>& terms, const AtPlace<float>& at) {
  const RayWeights<float> weights = ray_weights(terms, at);
  return {weights.au, weights.av};
}

template <class AnySplat>
__device__ __forceinline__ auto terms_of(const AnySplat& splat, int y) {
  return row_terms(splat, float(y));
}
__device__ __forceinline__ const LensTerms<float>& terms_of(const LensLocal& splat, int) { return splat.terms; }

template <int kRays>
using LaneMoments = std::conditional_t<kRays == kLensRays, LensRowSums,
                                       std::conditional_t<kRays == kNoRays, FlatRowSums, RayRowMoments>>;

// Sums values over a warp, ten of them in 12 shuffles: each step halves those that a lane keeps and doubles the lanes
// that are summed. The lane ends with the sum of `value`, or with none (-1).
template <int kCount, int kStep = 16>
__device__ __forceinline__ float warp_sum(const float (&v)[kCount], int first, int end, int& value) {
  if constexpr (kStep == 0) {
    static_assert(kCount == 1, "a warp has 32 lanes");
    value = first < end ? first : -1;
    return v[0];
  } else {
    constexpr int kHalf = (kCount + 1) / 2;
    const bool upper = threadIdx.x & kStep;
    float kept[kHalf];
#pragma unroll
    for (int i = 0; i < kHalf; ++i) {
      const float high = kHalf + i < kCount ? v[kHalf + i] : 0;
      if constexpr (kCount > 1)
        kept[i] = (upper ? high : v[i]) + __shfl_xor_sync(kWarp, upper ? v[i] : high, kStep);
      else  // all lanes keep the sum, of which one alone is said
        kept[i] = v[i] + __shfl_xor_sync(kWarp, v[i], kStep);
    }
    const int middle = first + kHalf;
    return warp_sum<kHalf, kStep / 2>(kept, upper ? middle : first, upper || middle > end ? end : middle, value);
  }
}

template <int kCount>
__device__ __forceinline__ void warp_sums(const float (&v)[kCount], float* sums) {
  int value;
  const float sum = warp_sum(v, 0, kCount, value);
  if (value >= 0) sums[value] = sum;
}

}  // namespace cuda
}  // namespace gs
