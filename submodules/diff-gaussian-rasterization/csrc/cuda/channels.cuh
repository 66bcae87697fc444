#pragma once
// Blending of many channels. Those of a pass are a pixel's registers.
#include <type_traits>

#include "../backend.h"
#include "blend_layout.cuh"

namespace gs {
namespace cuda {

// Calls run with a constant that is at least the number of a pass's channels.
template <class Run>
void by_width(int64_t count, const Run& run) {
  if (count > 16)
    run(std::integral_constant<int, kMostChannels>());
  else if (count > 4)
    run(std::integral_constant<int, 16>());
  else
    run(std::integral_constant<int, 4>());
}

// The channels of a batch of splats in shared memory; what a pass lacks is 0.
template <int kCount, int kWidth>
struct ChannelBatch {
  float4 values[kCount][kWidth / 4];

  // All threads of a block, `threads` of them, call this. instances: the batch's.
  __device__ void put(const Channels<float>& pass, const int32_t* instances, int count, int threads) {
    float* to = &values[0][0].x;
    for (int i = threadIdx.x; i < count * kWidth; i += threads) {
      const int k = i / kWidth, c = i % kWidth;
      to[i] = c < pass.count ? pass.values[int64_t(instances[k]) * pass.stride + c] : 0;
    }
  }
};

}  // namespace cuda
}  // namespace gs
