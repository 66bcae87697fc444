#pragma once
// The layers of math/layers.h, as kernels read and write them.
#include <cuda_runtime.h>

#include "math/layers.h"

namespace gs {
namespace cuda {

using namespace baseline;

template <class Color, class Depth>
struct LayersOf {
  Color* color;  // red, green, blue, and the transmittance in front
  Depth* depth;
};
using Layers = LayersOf<float4, float>;
using MadeLayers = LayersOf<const float4, const float>;

inline Layers layers_at(float* values, int64_t instances) {
  return {reinterpret_cast<float4*>(values), values + 4 * layer_pixels(instances)};
}
inline MadeLayers layers_at(const float* values, int64_t instances) {
  return {reinterpret_cast<const float4*>(values), values + 4 * layer_pixels(instances)};
}

// Where the pixels of a chunk's layer begin.
__device__ inline int64_t layer_pixel(int64_t begin, int64_t chunk) {
  return layer_place(begin, chunk) * kTile * kTile;
}

}  // namespace cuda
}  // namespace gs
