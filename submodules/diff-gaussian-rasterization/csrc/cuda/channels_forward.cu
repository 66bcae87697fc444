// Blends many channels front to back, a block per tile, in images of any size.
#include "channels.cuh"

namespace gs {
namespace cuda {

namespace {

using L = Layout<2>;

// A lane's pixels, of a picture that grows front to back.
template <int kWidth>
struct ChannelPicture {
  static constexpr int kRun = L::kRun;
  float transmittance[kRun], color[kRun][kWidth];
  float threshold[kRun];  // log2 alpha that a splat must reach; infinite once the pixel has ended
  int last[kRun];

  __device__ ChannelPicture(Image image, const L& at, int left, int top) {
#pragma unroll
    for (int p = 0; p < kRun; ++p) {
      transmittance[p] = 1, last[p] = 0;
#pragma unroll
      for (int c = 0; c < kWidth; ++c) color[p][c] = 0;
      const bool inside = left + at.x + at.column(p) < image.width && top + at.y < image.height;
      threshold[p] = inside ? kLeast : INFINITY;
    }
  }

  __device__ bool open() const {
    bool any = false;
#pragma unroll
    for (int p = 0; p < kRun; ++p) any |= threshold[p] < 0;
    return __any_sync(kWarp, any);
  }

  // Finds a splat's weights, which are 0 where it is not blended. position: behind the splat in its list. Tells whether
  // one is blended at any pixel of the warp.
  template <class Row>
  __device__ bool weigh(const Row& row, const L& at, float cap, int position, float (&weight)[kRun]) {
    bool any = false;
#pragma unroll
    for (int p = 0; p < kRun; ++p) {
      const float t = exponent_at(row, float(at.x + at.column(p)));
      weight[p] = 0;
      if (!(t >= threshold[p])) continue;
      const float alpha = capped<float, float>(exp2_device(t), cap);
      const float after = transmittance[p] - alpha * transmittance[p];
      if (after < float(kMinTransmittance)) {
        threshold[p] = INFINITY;
      } else {
        weight[p] = alpha * transmittance[p], transmittance[p] = after;
        last[p] = position, any = true;
      }
    }
    return __any_sync(kWarp, any);
  }

  template <class Values>
  __device__ void add(const float (&weight)[kRun], const Values& values) {
#pragma unroll
    for (int c = 0; c < kWidth; c += 4) {
      const float4 value = values[c / 4];
#pragma unroll
      for (int p = 0; p < kRun; ++p) {
        color[p][c] += weight[p] * value.x, color[p][c + 1] += weight[p] * value.y;
        color[p][c + 2] += weight[p] * value.z, color[p][c + 3] += weight[p] * value.w;
      }
    }
  }

  __device__ void write(const BlendInput<float>& in, int64_t count, const L& at, int left, int top,
                        const Blended<float>& out) const {
    const int64_t plane = int64_t(in.image.width) * in.image.height;
#pragma unroll
    for (int p = 0; p < kRun; ++p) {
      const int x = left + at.x + at.column(p), y = top + at.y;
      if (x >= in.image.width || y >= in.image.height) continue;
      const int64_t pixel = int64_t(y) * in.image.width + x;
#pragma unroll
      for (int c = 0; c < kWidth; ++c)
        if (c < count) out.color[c * plane + pixel] = color[p][c] + transmittance[p] * in.background[c];
      out.transmittance[pixel] = transmittance[p];
      out.last[pixel] = last[p];
    }
  }
};

template <int kRays, int kWidth>
__global__ void __launch_bounds__(L::kThreads)
    blend_channels_kernel(const int32_t* halted, BlendInput<float> in, Channels<float> pass, Blended<float> out) {
  if (!begin_work(halted)) return;
  constexpr int kBatch = L::kThreads;
  __shared__ Batch<kBatch, kRays> batch;
  __shared__ ChannelBatch<kBatch, kWidth> channels;
  const int across = tile_count(in.image.width), tile = blockIdx.x;
  const L at;
  const int left = tile % across * kTile, top = tile / across * kTile;
  ChannelPicture<kWidth> picture(in.image, at, left, top);
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
        float weight[L::kRun];
        if (picture.weigh(batch.terms(k, at), at, pass.cap, int(first - begin) + k + 1, weight))
          picture.add(weight, channels.values[k]);
      }
      open = picture.open();
    }
  }
  picture.write(in, pass.count, at, left, top, out);
}

}  // namespace

template <>
void blend_channels<float>(const Queue& queue, const BlendInput<float>& in, const Channels<float>& channels,
                           const Blended<float>& out) {
  each_pass(channels, in, [&](int64_t, const Channels<float>& pass, const BlendInput<float>& own, int64_t plane) {
    Blended<float> image = out;
    image.color += plane;
    by_width(pass.count, [&](auto width) {
      const auto kernel = in.rays ? blend_channels_kernel<kPinholeRays, width> : blend_channels_kernel<kNoRays, width>;
      launch(queue, "blend_channels", kernel, unsigned(tiles_of(in.image)), L::kThreads, own, pass, image);
    });
  });
}

}  // namespace cuda
}  // namespace gs
