#pragma once
// A row of the tensor `splats`: ten floats, moved in pairs.
#include <cuda_runtime.h>

#include "../math/splat.h"

namespace gs {
namespace cuda {

__device__ __forceinline__ void store_splat(float* splats, int64_t index, const baseline::Splat<float>& s) {
  float2* to = reinterpret_cast<float2*>(splats + baseline::kSplatValues * index);
  to[0] = make_float2(s.x, s.y);
  to[1] = make_float2(s.l11, s.l12);
  to[2] = make_float2(s.l22, s.log2_opacity);
  to[3] = make_float2(s.r, s.g);
  to[4] = make_float2(s.b, s.inverse_depth);
}

__device__ __forceinline__ baseline::Splat<float> load_splat(const float* splats, int64_t index) {
  const float2* from = reinterpret_cast<const float2*>(splats + baseline::kSplatValues * index);
  const float2 mean = from[0], l1 = from[1], l2 = from[2], red_green = from[3], rest = from[4];
  return {mean.x, mean.y, l1.x, l1.y, l2.x, l2.y, red_green.x, red_green.y, rest.x, rest.y};
}

// The splat without its colour and inverse depth, which are 0.
__device__ __forceinline__ baseline::Splat<float> load_shape(const float* splats, int64_t index) {
  const float2* from = reinterpret_cast<const float2*>(splats + baseline::kSplatValues * index);
  const float2 mean = from[0], l1 = from[1], l2 = from[2];
  return {mean.x, mean.y, l1.x, l1.y, l2.x, l2.y, 0, 0, 0, 0};
}

}  // namespace cuda
}  // namespace gs
