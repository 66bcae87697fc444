#pragma once
// What splats show: colours, with or without an inverse depth, or the channels of a pass. Either are a pixel's
// registers.
#include "backend.h"
#include "blend_layout.cuh"

namespace gs {
namespace cuda {

// kChannels: whether they are channels, of which a pass may have fewer than kWidth.
template <int kWidth_, bool kChannels_>
struct Payload {
  static constexpr int kWidth = kWidth_;
  static constexpr bool kChannels = kChannels_, kDepth = !kChannels && kWidth == 4;
  static constexpr bool kWide = kWidth > 4;  // a lane's pixels take values together, since each load costs as much
  static constexpr int kPlanes = kWidth - kDepth;  // of the image, with a background

  __device__ static float cap(const BlendInput<float>& in) { return kChannels ? in.channels.cap : float(kMaxAlpha); }
};
template <bool kDepth>
using Colors = Payload<kDepth ? 4 : 3, false>;

// Calls run with the payload of a pass over channels.
template <class Run>
void by_width(int64_t count, const Run& run) {
  if (count > 16)
    run(Payload<kMostChannels, true>());
  else if (count > 4)
    run(Payload<16, true>());
  else
    run(Payload<4, true>());
}

// A batch of splats and what they show, in fours. Channels that a pass lacks are 0.
template <int kCount, int kRays, class P>
struct PayloadBatch : Batch<kCount, kRays> {
  __device__ void put_channels(const BlendInput<float>&, const int32_t*, int, int) {}
  __device__ float4 four(int k, int) const {
    const float4 c = this->color[k];
    return make_float4(c.x, c.y, c.z, this->rest[k].w);
  }
};
template <int kCount, int kRays, int kWidth>
struct PayloadBatch<kCount, kRays, Payload<kWidth, true>> : Batch<kCount, kRays> {
  float4 values[kCount][kWidth / 4];

  // All threads of a block, `threads` of them, call this. instances: the batch's.
  __device__ void put_channels(const BlendInput<float>& in, const int32_t* instances, int count, int threads) {
    float* to = &values[0][0].x;
    for (int i = threadIdx.x; i < count * kWidth; i += threads) {
      const int k = i / kWidth, c = i % kWidth;
      const Channels<float>& from = in.channels;
      to[i] = c < from.count ? from.values[int64_t(instances[k]) * from.stride + c] : 0;
    }
  }
  __device__ float4 four(int k, int i) const { return values[k][i]; }
};

__device__ __forceinline__ float part(const float4& four, int i) {
  return i == 0 ? four.x : i == 1 ? four.y : i == 2 ? four.z : four.w;
}

// The backward's inputs at a lane's pixels. Positions count from the chunk's first splat, which saves a register.
template <class L, class P>
struct Pixels {
  float gradient[L::kRun][P::kWidth];                 // of what is shown
  float background[L::kRun], transmittance[L::kRun];  // of the background: its value, its share
  int last[L::kRun], furthest;                        // furthest: the warp's largest

  __device__ Pixels(const BlendInput<float>& in, const BlendGradient<float>& g, const L& at, int left, int top,
                    int first) {
    const int64_t plane = P::kChannels ? in.channels.plane : int64_t(in.image.width) * in.image.height;
    furthest = 0;
#pragma unroll
    for (int p = 0; p < L::kRun; ++p) {
      const int x = left + at.x + at.column(p), y = top + at.y;
      const bool inside = x < in.image.width && y < in.image.height;
      const int64_t pixel = inside ? int64_t(y) * in.image.width + x : 0;
      transmittance[p] = inside ? g.transmittance[pixel] : 1;
      last[p] = inside ? g.last[pixel] - first : 0;
      const float* const color = g.color + (P::kChannels ? in.channels.pixel : 1) * pixel;
#pragma unroll
      for (int c = 0; c < P::kWidth; ++c) {
        const bool depth = P::kDepth && c == 3, exists = inside && (!P::kChannels || c < in.channels.count);
        gradient[p][c] = !exists ? 0 : depth ? g.inverse_depth[pixel] : color[c * plane];
      }
      background[p] = in.background[0] * gradient[p][0];
#pragma unroll
      for (int c = 1; c < P::kPlanes; ++c)
        if (!P::kChannels || c < in.channels.count) background[p] += in.background[c] * gradient[p][c];
      if (g.transmittance_gradient && inside) background[p] += g.transmittance_gradient[pixel];
      furthest = last[p] > furthest ? last[p] : furthest;
    }
    furthest = warp_max(furthest);
  }

  // Whether a pixel of the warp blends the splat at `position`, by its exponents.
  __device__ bool blended(int position, const float (&exponent)[L::kRun]) const {
    bool any = false;
#pragma unroll
    for (int p = 0; p < L::kRun; ++p) any |= exponent[p] >= kLeast && position < last[p];
    return __any_sync(kWarp, any);
  }

  // What splat k shows, by its gradient: a function of the pixel. A lane's pixels share the loads of channels.
  template <class B>
  __device__ __forceinline__ auto value_of(const B& batch, int k) const {
    if constexpr (P::kWide) {
      struct {
        float2 sum[L::kRun] = {};
        __device__ __forceinline__ float operator()(int p) const { return sum[p].x + sum[p].y; }
      } values;
#pragma unroll
      for (int c = 0; c < P::kWidth; c += 4) {
        const float4 four = batch.four(k, c / 4);
#pragma unroll
        for (int p = 0; p < L::kRun; ++p) {
          float2& sum = values.sum[p];
          sum.x += four.x * gradient[p][c], sum.y += four.y * gradient[p][c + 1];
          sum.x += four.z * gradient[p][c + 2], sum.y += four.w * gradient[p][c + 3];
        }
      }
      return values;
    } else {
      return [this, color = batch.four(k, 0)](int p) { return value(p, color); };
    }
  }
  __device__ __forceinline__ float value(int p, const float4& color) const {
    float sum = color.x * gradient[p][0];
#pragma unroll
    for (int c = 1; c < P::kWidth; ++c) sum += part(color, c) * gradient[p][c];
    return sum;
  }
};

}  // namespace cuda
}  // namespace gs
