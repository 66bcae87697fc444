// Blends many channels front to back, a block per tile, in images of any size.
#include "channels.cuh"

namespace gs {
namespace cuda {

namespace {

using L = Layout<2>;

template <int kRays, int kWidth>
__global__ void __launch_bounds__(L::kThreads)
    blend_channels_kernel(const int32_t* halted, BlendInput<float> in, Channels<float> pass, Blended<float> out) {
  if (!begin_work(halted)) return;
  constexpr int kBatch = L::kThreads, kRun = L::kRun;
  __shared__ Batch<kBatch, kRays> batch;
  __shared__ ChannelBatch<kBatch, kWidth> channels;
  const int across = tile_count(in.image.width), tile = blockIdx.x;
  const L at;
  const int left = tile % across * kTile, top = tile / across * kTile;
  float transmittance[kRun], color[kRun][kWidth], threshold[kRun];
  int last[kRun];
#pragma unroll
  for (int p = 0; p < kRun; ++p) {
    transmittance[p] = 1, last[p] = 0;
#pragma unroll
    for (int c = 0; c < kWidth; ++c) color[p][c] = 0;
    const bool inside = left + at.x + at.column(p) < in.image.width && top + at.y < in.image.height;
    threshold[p] = inside ? kLeast : INFINITY;
  }
  bool open = true;
  const int64_t begin = in.ranges[tile], end = in.ranges[tile + 1];
  for (int64_t first = begin; first < end; first += kBatch) {
    if (!__syncthreads_or(open)) break;
    const int count = int(end - first < kBatch ? end - first : kBatch);
    const int mine = threadIdx.x;
    if (mine < count) batch.put(mine, in, tile, in.instances[first + mine], float(left), float(top));
    channels.put(pass, in.instances + first, count, L::kThreads);
    __syncthreads();
    for (int from = 0; open && from < count; from += 32) {
      for (unsigned hits = reached_by_warp(batch, at, from, count); hits; hits &= hits - 1) {
        const int k = from + __ffs(hits) - 1;
        const auto row = batch.terms(k, at);
        float weight[kRun];
        bool any = false;
#pragma unroll
        for (int p = 0; p < kRun; ++p) {
          const float t = exponent_at(row, float(at.x + at.column(p)));
          weight[p] = 0;
          if (!(t >= threshold[p])) continue;
          const float alpha = capped<float, float>(exp2_device(t), pass.cap);
          const float after = transmittance[p] - alpha * transmittance[p];
          if (after < float(kMinTransmittance)) {
            threshold[p] = INFINITY;
          } else {
            weight[p] = alpha * transmittance[p], transmittance[p] = after;
            last[p] = int(first - begin) + k + 1, any = true;
          }
        }
        if (!__any_sync(kWarp, any)) continue;
#pragma unroll
        for (int c = 0; c < kWidth; c += 4) {
          const float4 value = channels.values[k][c / 4];
#pragma unroll
          for (int p = 0; p < kRun; ++p) {
            color[p][c] += weight[p] * value.x, color[p][c + 1] += weight[p] * value.y;
            color[p][c + 2] += weight[p] * value.z, color[p][c + 3] += weight[p] * value.w;
          }
        }
      }
      bool any = false;
#pragma unroll
      for (int p = 0; p < kRun; ++p) any |= threshold[p] < 0;
      open = __any_sync(kWarp, any);
    }
  }
  const int64_t plane = int64_t(in.image.width) * in.image.height;
#pragma unroll
  for (int p = 0; p < kRun; ++p) {
    const int x = left + at.x + at.column(p), y = top + at.y;
    if (x >= in.image.width || y >= in.image.height) continue;
    const int64_t pixel = int64_t(y) * in.image.width + x;
#pragma unroll
    for (int c = 0; c < kWidth; ++c)
      if (c < pass.count) out.color[c * plane + pixel] = color[p][c] + transmittance[p] * in.background[c];
    out.transmittance[pixel] = transmittance[p];
    out.last[pixel] = last[p];
  }
}

}  // namespace

template <>
void blend_channels<float>(const Queue& queue, const BlendInput<float>& in, const Channels<float>& channels,
                           const Blended<float>& out) {
  for (int64_t first = 0; first < channels.count; first += kMostChannels) {
    const Channels<float> pass = channels.pass(first);
    BlendInput<float> own = in;
    Blended<float> image = out;
    own.background += first, image.color += first * in.image.width * in.image.height;
    by_width(pass.count, [&](auto width) {
      const auto kernel = in.rays ? blend_channels_kernel<kPinholeRays, width> : blend_channels_kernel<kNoRays, width>;
      launch(queue, "blend_channels", kernel, unsigned(tiles_of(in.image)), L::kThreads, own, pass, image);
    });
  }
}

}  // namespace cuda
}  // namespace gs
