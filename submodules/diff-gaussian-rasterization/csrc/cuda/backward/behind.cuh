#pragma once
// What a backward finds behind a chunk: the layers of the chunks there, and the background.
#include "cuda/blend/blend_layout.cuh"

namespace gs {
namespace cuda {

// A chunk as a pixel sees it: with `behind` behind the chunk, the pixel has value + transmittance * behind.
struct alignas(8) Layer {
  float value, transmittance;
};

// Starts the backward of a lane's pixels at their chunk's end. Behind the chunk lie `count` layers from `first` on,
// then the background: `behind` is what they show together, `through` their transmittance.
template <class L, class Pixels>
__device__ __forceinline__ void start_behind(const Pixels& pixels, const L& at, const Layer* layers, int32_t first,
                                             int count, float (&transmittance)[L::kRun], float (&behind)[L::kRun],
                                             float (&through)[L::kRun]) {
  constexpr int kRun = L::kRun;
  for (int p = 0; p < kRun; ++p) behind[p] = pixels.background[p], through[p] = 1;
  for (int c = count - 1; c >= 0; --c)
    for (int p = 0; p < kRun; ++p) {
      const int pixel = at.y * kTile + at.x + at.column(p);
      const Layer layer = layers[int64_t(kTile * kTile) * (first + c) + pixel];
      behind[p] = layer.value + layer.transmittance * behind[p];
      through[p] *= layer.transmittance;
    }
  for (int p = 0; p < kRun; ++p) transmittance[p] = pixels.transmittance[p] / through[p];
}

}  // namespace cuda
}  // namespace gs
