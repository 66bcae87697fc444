// Blends each tile's list front to back, a block per tile. Images of few tiles go another way.
#include "../backend.h"
#include "blend_chunks.cuh"
#include "blend_layout.cuh"

namespace gs {
namespace cuda {

namespace {

using L = Layout<2>;

// Bounding blocks per multiprocessor limits the kernel to 56 registers on sm_90, without spills but on rays with depth.
template <int kRays, bool kDepth, bool kLast>
__global__ void __launch_bounds__(L::kThreads, blocks_at_once(kRays == kLensRays ? 6 : 9, L::kThreads))
    blend_kernel(const int32_t* halted, BlendInput<float> in, Blended<float> out) {
  if (!begin_work(halted)) return;
  constexpr int kBatch = L::kThreads, kRun = L::kRun;
  __shared__ Batch<kBatch, kRays> batch;
  const int across = tile_count(in.image.width), tile = blockIdx.x;
  const PlacesOf<L, kRays> at(in, tile);
  const int left = tile % across * kTile, top = tile / across * kTile;
  float transmittance[kRun], red[kRun], green[kRun], blue[kRun], depth[kRun], threshold[kRun];
  int last[kRun];
  for (int p = 0; p < kRun; ++p) {
    transmittance[p] = 1, red[p] = green[p] = blue[p] = depth[p] = 0, last[p] = 0;
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
    __syncthreads();
    for (int from = 0; open && from < count; from += 32) {
      front_to_back(batch, at, from, count, [&](int k, int p, float t) {
        if (!(t >= threshold[p])) return;
        const float alpha = capped<float, float>(exp2_device(t));
        const float after = transmittance[p] - alpha * transmittance[p];
        const bool ends = after < float(kMinTransmittance);
        const float4 c = batch.color[k];
        if (!ends) {
          const float weight = alpha * transmittance[p];
          red[p] += weight * c.x, green[p] += weight * c.y, blue[p] += weight * c.z;
          if (kDepth) depth[p] += weight * batch.rest[k].w;
          if (kLast) last[p] = int(first - begin) + k + 1;
          transmittance[p] = after;
        }
        if (ends) threshold[p] = INFINITY;
      });
      bool any = false;
      for (int p = 0; p < kRun; ++p) any |= threshold[p] < 0;
      open = __any_sync(kWarp, any);
    }
  }
  for (int p = 0; p < kRun; ++p) {
    const int x = left + at.x + at.column(p), y = top + at.y;
    if (x >= in.image.width || y >= in.image.height) continue;
    const int64_t pixel = int64_t(y) * in.image.width + x, plane = int64_t(in.image.width) * in.image.height;
    out.color[pixel] = red[p] + transmittance[p] * in.background[0];
    out.color[plane + pixel] = green[p] + transmittance[p] * in.background[1];
    out.color[2 * plane + pixel] = blue[p] + transmittance[p] * in.background[2];
    out.transmittance[pixel] = transmittance[p];
    if (kDepth) out.inverse_depth[pixel] = depth[p];
    if (kLast) out.last[pixel] = last[p];
  }
}

template <int kRays>
auto blend_kernel_for(const Blended<float>& out) {
  return out.inverse_depth ? (out.last ? blend_kernel<kRays, true, true> : blend_kernel<kRays, true, false>)
                           : (out.last ? blend_kernel<kRays, false, true> : blend_kernel<kRays, false, false>);
}

}  // namespace

template <>
void blend<float>(const Queue& queue, const BlendInput<float>& in, const Blended<float>& out) {
  if (makes_layers(in.image)) return blend_chunks(queue, in, out);
  const auto kernel = in.rays == kLensRays ? blend_kernel_for<kLensRays>(out)
                      : in.rays            ? blend_kernel_for<kPinholeRays>(out)
                                           : blend_kernel_for<kNoRays>(out);
  launch(queue, "blend", kernel, unsigned(tiles_of(in.image)), L::kThreads, in, out);
}

}  // namespace cuda
}  // namespace gs
