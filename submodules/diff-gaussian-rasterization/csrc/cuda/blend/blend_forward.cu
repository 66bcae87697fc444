// Blends each tile's list front to back, a block per tile. Colours of images of few tiles go another way.
#include "blend_chunks.cuh"
#include "payload.cuh"

namespace gs {
namespace cuda {

namespace {

using L = Layout<2>;

// A lane's pixels, of a picture that grows front to back.
template <class P, bool kLast>
struct Picture {
  static constexpr int kRun = L::kRun, kWidth = P::kWidth;
  float transmittance[kRun], payload[kRun][kWidth];
  float threshold[kRun];  // log2 alpha that a splat must reach; infinite once the pixel has ended
  int last[kRun];

  __device__ __forceinline__ Picture(Image image, const L& at, int left, int top) {
#pragma unroll
    for (int p = 0; p < kRun; ++p) {
      transmittance[p] = 1, last[p] = 0;
#pragma unroll
      for (int c = 0; c < kWidth; ++c) payload[p][c] = 0;
      const bool inside = left + at.x + at.column(p) < image.width && top + at.y < image.height;
      threshold[p] = inside ? kLeast : INFINITY;
    }
  }

  __device__ __forceinline__ void add(int p, float weight, int four, const float4& values) {
#pragma unroll
    for (int c = 0; c < 4 && 4 * four + c < kWidth; ++c) payload[p][4 * four + c] += weight * part(values, c);
  }

  // Blends splat k of a batch, with these exponents. position: behind the splat in its list.
  template <class B>
  __device__ __forceinline__ void blend(const B& batch, int k, int position, float cap, const float (&t)[kRun]) {
    float weight[kRun] = {};
    bool any = false;
#pragma unroll
    for (int p = 0; p < kRun; ++p) {
      if (!(t[p] >= threshold[p])) continue;
      const float alpha = capped<float, float>(exp2_device(t[p]), cap);
      const float after = transmittance[p] - alpha * transmittance[p];
      const bool ends = after < float(kMinTransmittance);
      const float4 values = batch.four(k, 0);
      if (!ends) {
        weight[p] = alpha * transmittance[p], any = true;
        if (!P::kWide) add(p, weight[p], 0, values);
        if (kLast) last[p] = position;
        transmittance[p] = after;
      }
      if (ends) threshold[p] = INFINITY;
    }
    if (!P::kWide || !__any_sync(kWarp, any)) return;
#pragma unroll
    for (int four = 0; four < kWidth / 4; ++four) {
      const float4 values = batch.four(k, four);
#pragma unroll
      for (int p = 0; p < kRun; ++p)
        if (weight[p] > 0) add(p, weight[p], four, values);  // elsewhere a value that is not finite does not show
    }
  }

  __device__ __forceinline__ void write(const BlendInput<float>& in, const L& at, int left, int top,
                                        const Blended<float>& out) const {
#pragma unroll
    for (int p = 0; p < kRun; ++p) {
      const int x = left + at.x + at.column(p), y = top + at.y;
      if (x >= in.image.width || y >= in.image.height) continue;
      const int64_t pixel = int64_t(y) * in.image.width + x;
      const int64_t plane = P::kChannels ? in.channels.plane : int64_t(in.image.width) * in.image.height;
      float* const color = out.color + (P::kChannels ? in.channels.pixel : 1) * pixel;
#pragma unroll
      for (int c = 0; c < P::kPlanes; ++c)
        if (!P::kChannels || c < in.channels.count)
          color[c * plane] = payload[p][c] + transmittance[p] * in.background[c];
      out.transmittance[pixel] = transmittance[p];
      if (P::kChannels && out.alpha) out.alpha[pixel] = 1 - transmittance[p];
      if (P::kDepth) out.inverse_depth[pixel] = payload[p][kWidth - 1];
      if (kLast) out.last[pixel] = last[p];
    }
  }
};

// Bounding blocks per multiprocessor limits the kernel for colours to 56 registers on sm_90, without spills but on rays
// with depth.
template <int kRays, class P>
constexpr int kBlocks = P::kWidth > 16       ? 4
                        : P::kWide           ? 5
                        : P::kChannels       ? 7
                        : kRays == kLensRays ? 6
                                             : 9;

template <int kRays, class P, bool kLast>
__global__ void __launch_bounds__(L::kThreads, blocks_at_once(kBlocks<kRays, P>, L::kThreads))
    blend_kernel(const int32_t* halted, BlendInput<float> in, Blended<float> out) {
  if (!begin_work(halted)) return;
  constexpr int kBatch = L::kThreads;
  __shared__ PayloadBatch<kBatch, kRays, P> batch;
  const int across = tile_count(in.image.width), tile = blockIdx.x;
  const PlacesOf<L, kRays> at(in, tile);
  const int left = tile % across * kTile, top = tile / across * kTile;
  Picture<P, kLast> picture(in.image, at, left, top);
  bool open = true;
  const int64_t begin = in.ranges[tile], end = in.ranges[tile + 1];
  for (int64_t first = begin; first < end; first += kBatch) {
    if (!__syncthreads_or(open)) break;
    const int count = int(end - first < kBatch ? end - first : kBatch);
    const int mine = threadIdx.x;
    if (mine < count) batch.put(mine, in, tile, in.instances[first + mine], float(left), float(top));
    batch.put_channels(in, in.instances + first, count, L::kThreads);
    __syncthreads();
    for (int from = 0; open && from < count; from += 32) {
      front_to_back(batch, at, from, count, [&](int k, const float (&t)[L::kRun]) {
        picture.blend(batch, k, int(first - begin) + k + 1, P::cap(in), t);
      });
      bool any = false;
      for (int p = 0; p < L::kRun; ++p) any |= picture.threshold[p] < 0;
      open = __any_sync(kWarp, any);
    }
  }
  picture.write(in, at, left, top, out);
}

template <int kRays>
auto blend_kernel_for(const Blended<float>& out) {
  return out.inverse_depth
             ? (out.last ? blend_kernel<kRays, Colors<true>, true> : blend_kernel<kRays, Colors<true>, false>)
             : (out.last ? blend_kernel<kRays, Colors<false>, true> : blend_kernel<kRays, Colors<false>, false>);
}

void blend_channels(const Queue& queue, const BlendInput<float>& in, const Blended<float>& out) {
  each_pass(in, [&](int64_t, const BlendInput<float>& pass, int64_t plane) {
    Blended<float> image = out;
    image.color += plane;
    by_width(pass.channels.count, [&](auto payload) {
      using P = decltype(payload);
      const auto kernel = in.rays ? blend_kernel<kPinholeRays, P, true> : blend_kernel<kNoRays, P, true>;
      launch(queue, "blend_channels", kernel, unsigned(tiles_of(in.image)), L::kThreads, pass, image);
    });
  });
}

}  // namespace

template <>
void blend<float>(const Queue& queue, const BlendInput<float>& in, const Blended<float>& out) {
  if (in.channels.count) return blend_channels(queue, in, out);
  if (makes_layers(in.image)) return blend_chunks(queue, in, out);
  const auto kernel = by_rays(in.rays, [&](auto rays) { return blend_kernel_for<rays>(out); });
  launch(queue, "blend", kernel, unsigned(tiles_of(in.image)), L::kThreads, in, out);
}

}  // namespace cuda
}  // namespace gs
