#pragma once
// A row of the tensor `splats`, moved in pairs.
#include <cuda_runtime.h>

#include "math/splat.h"

namespace gs {
namespace cuda {

using baseline::kSplatRow, baseline::LensRaySplat, baseline::RaySplat, baseline::Splat, baseline::SplatOf;

__device__ __forceinline__ void store_pairs(float2* to, const Splat<float>& s) {
  to[0] = make_float2(s.x, s.y);
  to[1] = make_float2(s.l11, s.l12);
  to[2] = make_float2(s.l22, s.log2_opacity);
  to[3] = make_float2(s.r, s.g);
  to[4] = make_float2(s.b, s.inverse_depth);
}
__device__ __forceinline__ void store_pairs(float2* to, const RaySplat<float>& s) {
  const Splat<float>& on_image = s;
  store_pairs(to, on_image);
  to[5] = make_float2(s.slope_u, s.slope_v);
  to[6] = make_float2(s.e, 0);
}
__device__ __forceinline__ void store_pairs(float2* to, const LensRaySplat<float>& s) {
  const RaySplat<float>& on_ray = s;
  store_pairs(to, on_ray);
  to[7] = make_float2(s.to_u.x, s.to_u.y);
  to[8] = make_float2(s.to_u.z, s.to_v.x);
  to[9] = make_float2(s.to_v.y, s.to_v.z);
  to[10] = make_float2(s.n.x, s.n.y);
  to[11] = make_float2(s.n.z, 0);
}

template <class AnySplat>
__device__ __forceinline__ void store_splat(float* splats, int64_t index, const AnySplat& s) {
  store_pairs(reinterpret_cast<float2*>(splats + sizeof s / sizeof(float) * index), s);
}

template <int kRays>
__device__ __forceinline__ const float2* pairs_of(const float* splats, int64_t index) {
  return reinterpret_cast<const float2*>(splats + kSplatRow<kRays> * index);
}

template <int kRays>
__device__ __forceinline__ SplatOf<float, kRays> with_slopes(const Splat<float>& s, const float2* from) {
  if constexpr (kRays != kNoRays) {
    const float2 slope = from[5], e = from[6];
    const RaySplat<float> on_ray = {s, slope.x, slope.y, e.x, 0};
    if constexpr (kRays == kLensRays) {
      const float2 a = from[7], b = from[8], c = from[9], d = from[10], n = from[11];
      return {on_ray, {a.x, a.y, b.x}, {b.y, c.x, c.y}, {d.x, d.y, n.x}, 0};
    } else {
      return on_ray;
    }
  } else {
    return s;
  }
}

template <int kRays>
__device__ __forceinline__ SplatOf<float, kRays> load_splat(const float* splats, int64_t index) {
  const float2* from = pairs_of<kRays>(splats, index);
  const float2 mean = from[0], l1 = from[1], l2 = from[2], red_green = from[3], rest = from[4];
  return with_slopes<kRays>({mean.x, mean.y, l1.x, l1.y, l2.x, l2.y, red_green.x, red_green.y, rest.x, rest.y}, from);
}

// The splat without its colour and inverse depth, which are 0.
template <int kRays>
__device__ __forceinline__ SplatOf<float, kRays> load_shape(const float* splats, int64_t index) {
  const float2* from = pairs_of<kRays>(splats, index);
  const float2 mean = from[0], l1 = from[1], l2 = from[2];
  return with_slopes<kRays>({mean.x, mean.y, l1.x, l1.y, l2.x, l2.y, 0, 0, 0, 0}, from);
}

}  // namespace cuda
}  // namespace gs
