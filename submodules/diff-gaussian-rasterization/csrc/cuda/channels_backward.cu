// The backward of blending many channels, in chunks as the one of colours (blend_backward.cu): geometry's sums in rows
// to which each pass adds, and the sums of the pass's channels in rows of their own.
#include "../math/slots.h"
#include "behind.cuh"
#include "channels.cuh"
#include "pixel_sums.cuh"
#include "processed.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kRowBatch = 32;                             // splats whose rows are written at once
constexpr int32_t kChunkOfFew = 256, kChunkOfMany = 512;  // splats, in an image of few tiles and of many

// A lane has fewer pixels where each takes many registers.
template <int kWidth>
using LayoutOf = Layout<(kWidth > 4 ? 2 : 4)>;

// The rows of a pass. shapes: (rows, kRow), as those of blend_rows, of which `adds` tells whether there are sums of
// other passes. channels: (rows, width).
struct PassRows {
  RowPlaces places;
  float *shapes, *channels;
  bool adds;
};

// The backward's inputs at a lane's pixels. Positions count from the chunk's first splat.
template <class L, int kWidth>
struct ChannelPixels {
  float gradient[L::kRun][kWidth];
  float background[L::kRun], transmittance[L::kRun];  // of the background: its value, its share
  int last[L::kRun], furthest;                        // furthest: the warp's largest

  __device__ ChannelPixels(const BlendInput<float>& in, const BlendGradient<float>& g, const Channels<float>& pass,
                           const L& at, int left, int top, int begin) {
    const int64_t plane = int64_t(in.image.width) * in.image.height;
    furthest = 0;
#pragma unroll
    for (int p = 0; p < L::kRun; ++p) {
      const int x = left + at.x + at.column(p), y = top + at.y;
      const bool inside = x < in.image.width && y < in.image.height;
      const int64_t pixel = inside ? int64_t(y) * in.image.width + x : 0;
      transmittance[p] = inside ? g.transmittance[pixel] : 1;
      last[p] = inside ? g.last[pixel] - begin : 0;
      background[p] = g.transmittance_gradient && inside ? g.transmittance_gradient[pixel] : 0;
#pragma unroll
      for (int c = 0; c < kWidth; ++c) {
        const bool there = inside && c < pass.count;
        gradient[p][c] = there ? g.color[c * plane + pixel] : 0;
        if (there) background[p] += in.background[c] * gradient[p][c];
      }
      furthest = last[p] > furthest ? last[p] : furthest;
    }
    furthest = warp_max(furthest);
  }

  // What a splat's channels add to the loss, for each pixel.
  template <int kBatch>
  __device__ void values(const ChannelBatch<kBatch, kWidth>& channels, int k, float (&out)[L::kRun]) const {
#pragma unroll
    for (int p = 0; p < L::kRun; ++p) out[p] = 0;
#pragma unroll
    for (int c = 0; c < kWidth; c += 4) {
      const float4 value = channels.values[k][c / 4];
#pragma unroll
      for (int p = 0; p < L::kRun; ++p) {
        out[p] += value.x * gradient[p][c] + value.y * gradient[p][c + 1];
        out[p] += value.z * gradient[p][c + 2] + value.w * gradient[p][c + 3];
      }
    }
  }
};

// Sums values over a warp: each step halves those that a lane keeps. The lane ends with the sum of `value`, or with
// none (-1).
template <int kCount, int kStep = 16>
__device__ __forceinline__ float warp_sum(const float (&v)[kCount], int first, int end, int& value) {
  if constexpr (kStep == 0) {
    static_assert(kCount == 1, "a warp has 32 lanes");
    value = first < end ? first : -1;
    return v[0];
  } else {
    constexpr int kHalf = (kCount + 1) / 2;
    const bool upper = threadIdx.x & kStep;
    float kept[kHalf];
#pragma unroll
    for (int i = 0; i < kHalf; ++i) {
      const float high = kHalf + i < kCount ? v[kHalf + i] : 0;
      if constexpr (kCount > 1)
        kept[i] = (upper ? high : v[i]) + __shfl_xor_sync(kWarp, upper ? v[i] : high, kStep);
      else  // all lanes keep the sum, of which one alone is said
        kept[i] = v[i] + __shfl_xor_sync(kWarp, v[i], kStep);
    }
    const int middle = first + kHalf;
    return warp_sum<kHalf, kStep / 2>(kept, upper ? middle : first, upper || middle > end ? end : middle, value);
  }
}

template <int kCount>
__device__ __forceinline__ void warp_sums(const float (&v)[kCount], float* sums) {
  int value;
  const float sum = warp_sum(v, 0, kCount, value);
  if (value >= 0) sums[value] = sum;
}

// Geometry's sums: moments, those of rays, and those of absolute gradients.
template <int kRays, bool kAbsolute>
constexpr int kShapes = 6 + (kRays ? kRayValues : 0) + (kAbsolute ? kAbsoluteValues : 0);

// Leaves the sums of a splat's geometry over a warp's pixels in `sums`.
template <bool kAbsolute, class Splat, class Row, class Moments>
__device__ __forceinline__ void sum_shapes(const Splat& splat, const Row& row, const Moments& moments, float absolute_u,
                                           float absolute_uv, float* sums) {
  constexpr int kRays = std::is_same_v<Splat, LocalSplat<float>> ? kNoRays : kPinholeRays;
  constexpr int kOwn = kShapes<kRays, kAbsolute>;
  float shape[kOwn];
  const auto keep = [&](const auto& all) {
#pragma unroll
    for (int i = 0; i < kOwn; ++i) shape[i] = all[i];
  };
  if constexpr (kRays != kNoRays) {
    const RayMoments<float> rays = moments.moments(row, splat);
    const auto& m = rays.on_image;
    const float all[] = {m.q, m.qu, m.qv, m.quu, m.quv, m.qvv, rays.pu, rays.pv, rays.pp, 0, absolute_u, absolute_uv};
    keep(all);
  } else {
    const auto m = moments.moments(row);
    const float all[] = {m.q, m.qu, m.qv, m.quu, m.quv, m.qvv, absolute_u, absolute_uv};
    keep(all);
  }
  warp_sums(shape, sums);
}

// The same of its channels.
template <class L, int kWidth>
__device__ __forceinline__ void sum_channels(const ChannelPixels<L, kWidth>& pixels, const float (&weight)[L::kRun],
                                             float* sums) {
  constexpr int kGroup = kWidth < 16 ? kWidth : 16;  // of more, a lane's registers would not hold the sums
#pragma unroll
  for (int c = 0; c < kWidth; c += kGroup) {
    float shown[kGroup];
#pragma unroll
    for (int i = 0; i < kGroup; ++i) {
      shown[i] = weight[0] * pixels.gradient[0][c + i];
#pragma unroll
      for (int p = 1; p < L::kRun; ++p) shown[i] += weight[p] * pixels.gradient[p][c + i];
    }
    warp_sums(shown, sums + c);
  }
}

// Steps the lanes over splat k of the batch, whose first splat is the chunk's splat `first`, and leaves the sums over
// the warp's pixels in `sums`: geometry's, then the channels'.
template <bool kAbsolute, int kBatch, int kRays, class L, int kWidth>
__device__ __forceinline__ void splat_gradient(const Batch<kBatch, kRays>& batch,
                                               const ChannelBatch<kBatch, kWidth>& channels,
                                               const ChannelPixels<L, kWidth>& pixels, const Channels<float>& pass,
                                               const L& at, int k, int first, float (&transmittance)[L::kRun],
                                               float (&behind)[L::kRun], float* sums) {
  constexpr int kRun = L::kRun;
  const auto splat = batch.local(k);
  const auto row = terms_of(splat, at.y);
  float exponent[kRun], weight[kRun], value[kRun];
  bool any = false;
#pragma unroll
  for (int p = 0; p < kRun; ++p) {
    const float t = exponent_at(row, float(at.x + at.column(p)));
    const bool reached = t >= kLeast && first + k < pixels.last[p];
    exponent[p] = reached ? t : -INFINITY;
    any |= reached;
  }
  if (!__any_sync(kWarp, any)) return;
  pixels.values(channels, k, value);
  LaneMoments<kRays> moments;
  float absolute_u = 0, absolute_uv = 0;
#pragma unroll
  for (int p = 0; p < kRun; ++p) {
    weight[p] = 0;
    if (!(exponent[p] >= kLeast)) continue;
    const auto here = at_pixel(row, float(at.x + at.column(p)));
    const float uncapped = exp2_device(exponent[p]), alpha = capped<float, float>(uncapped, pass.cap);
    const float slope = alpha_gradient<float, float>(alpha, value[p], transmittance[p], behind[p]);
    const float q = pass.stops && uncapped > pass.cap ? 0 : uncapped * slope;
    weight[p] = alpha * transmittance[p];
    add_pixel(moments, row, here, q);
    if (kAbsolute) {
      const float2 by = pull(splat, row, here);
      absolute_u += fabsf(q * by.x), absolute_uv += fabsf(q * (splat.l12 * by.x + splat.l22 * by.y));
    }
  }
  sum_shapes<kAbsolute>(splat, row, moments, absolute_u, absolute_uv, sums);
  sum_channels(pixels, weight, sums + kShapes<kRays, kAbsolute>);
}

// Computes the layers of all chunks but the first of each tile, a block each.
template <int kRays, int kWidth>
__global__ void __launch_bounds__(Layout<2>::kThreads)
    channel_layers_kernel(const int32_t* halted, BlendInput<float> in, Channels<float> pass, BlendGradient<float> g,
                          const Chunk* chunks, Layer* layers) {
  if (!begin_work(halted)) return;
  using L = Layout<2>;
  constexpr int kBatch = L::kThreads, kRun = L::kRun;
  __shared__ Batch<kBatch, kRays> batch;
  __shared__ ChannelBatch<kBatch, kWidth> channels;
  const Chunk chunk = chunks[blockIdx.x];
  if (chunk.tile < 0 || chunk.first == 0) return;
  const L at;
  const int across = tile_count(in.image.width);
  const int left = chunk.tile % across * kTile, top = chunk.tile / across * kTile;
  const ChannelPixels<L, kWidth> pixels(in, g, pass, at, left, top, chunk.first);
  float value[kRun], transmittance[kRun];
#pragma unroll
  for (int p = 0; p < kRun; ++p) value[p] = 0, transmittance[p] = 1;
  const int32_t* instances = in.instances + in.ranges[chunk.tile] + chunk.first;
  const int length = chunk.end - chunk.first, mine = threadIdx.x;
  for (int first = 0; first < length; first += kBatch) {
    const int count = length - first < kBatch ? length - first : kBatch;
    __syncthreads();
    if (mine < count) batch.put(mine, in, chunk.tile, instances[first + mine], float(left), float(top));
    channels.put(pass, instances + first, count, L::kThreads);
    __syncthreads();
    for (int from = 0; from < count && first + from < pixels.furthest; from += 32)
      for (unsigned hits = reached_by_warp(batch, at, from, count); hits; hits &= hits - 1) {
        const int k = from + __ffs(hits) - 1;
        const auto row = batch.terms(k, at);
        float weight[kRun], seen[kRun];
        bool any = false;
#pragma unroll
        for (int p = 0; p < kRun; ++p) {
          const float t = exponent_at(row, float(at.x + at.column(p)));
          const bool blended = t >= kLeast && first + k < pixels.last[p];
          weight[p] = blended ? capped<float, float>(exp2_device(t), pass.cap) * transmittance[p] : 0;
          any |= blended;
        }
        if (!__any_sync(kWarp, any)) continue;
        pixels.values(channels, k, seen);
#pragma unroll
        for (int p = 0; p < kRun; ++p) value[p] += weight[p] * seen[p], transmittance[p] -= weight[p];
      }
  }
  Layer* to = layers + int64_t(kTile * kTile) * (chunk.behind - 1) + at.y * kTile + at.x;
#pragma unroll
  for (int p = 0; p < kRun; ++p) to[at.column(p)] = {value[p], transmittance[p]};
}

// Writes the rows of a batch from the sums of a block's warps.
template <int kRays, int kWidth, bool kAbsolute>
__device__ void write_rows(const float* sums, const int64_t* row_of, int count, int64_t channels,
                           const PassRows& rows) {
  using L = LayoutOf<kWidth>;
  constexpr int kOwn = kShapes<kRays, kAbsolute>, kValues = kOwn + kWidth;
  constexpr int kRow = kGradientRow<kRays> + (kAbsolute ? kAbsoluteValues : 0);
  constexpr int kColors = kRow - kOwn;  // after the moments
  const auto sum_of = [&](int k, int value) {
    float sum = 0;
    for (int w = 0; w < L::kWarps; ++w) sum += sums[(w * kRowBatch + k) * kValues + value];
    return sum;
  };
  for (int i = threadIdx.x; i < count * kRow; i += L::kThreads) {
    const int k = i / kRow, v = i % kRow, channel = v - 6;
    float* to = rows.shapes + kRow * row_of[k] + v;
    if (v < 6 || channel >= kColors)
      *to = sum_of(k, v < 6 ? v : v - kColors) + (rows.adds ? *to : 0);
    else if (!rows.adds)
      *to = channel < 3 && channel < channels ? sum_of(k, kOwn + channel) : 0;
  }
  if (rows.channels)
    for (int i = threadIdx.x; i < count * kWidth; i += L::kThreads)
      rows.channels[kWidth * row_of[i / kWidth] + i % kWidth] = sum_of(i / kWidth, kOwn + i % kWidth);
}

// Walks each chunk back to front, a block each, and writes its rows.
template <int kRays, int kWidth, bool kAbsolute>
__global__ void __launch_bounds__(LayoutOf<kWidth>::kThreads)
    channels_vjp_kernel(const int32_t* halted, BlendInput<float> in, Channels<float> pass, BlendGradient<float> g,
                        const int32_t* processed, const Chunk* chunks, int chunk_size, const Layer* layers,
                        PassRows rows) {
  if (!begin_work(halted)) return;
  using L = LayoutOf<kWidth>;
  constexpr int kBatch = kRowBatch, kValues = kShapes<kRays, kAbsolute> + kWidth;
  __shared__ Batch<kBatch, kRays> batch;
  __shared__ ChannelBatch<kBatch, kWidth> channels;
  __shared__ float sums[L::kWarps * kBatch * kValues];
  __shared__ int64_t row_of[kBatch];
  const Chunk chunk = chunks[blockIdx.x];
  if (chunk.tile < 0) return;
  const L at;
  const int across = tile_count(in.image.width);
  const int left = chunk.tile % across * kTile, top = chunk.tile / across * kTile;
  const ChannelPixels<L, kWidth> pixels(in, g, pass, at, left, top, chunk.first);
  float transmittance[L::kRun], behind[L::kRun], through[L::kRun];
  const int layers_behind = (processed[chunk.tile] - chunk.end + chunk_size - 1) / chunk_size;
  start_behind(pixels, at, layers, chunk.behind, layers_behind, transmittance, behind, through);
  const int32_t* instances = in.instances + in.ranges[chunk.tile] + chunk.first;
  float* own = sums + threadIdx.x / 32 * kBatch * kValues;
  for (int end = chunk.end - chunk.first; end > 0; end -= kBatch) {
    const int count = end < kBatch ? end : kBatch, first = end - count;
    __syncthreads();
    for (int k = threadIdx.x; k < count; k += L::kThreads) {
      const int32_t splat = instances[first + k];
      batch.put(k, in, chunk.tile, splat, float(left), float(top));
      row_of[k] = rows.places.row(slot_of(g.slots, splat, chunk.tile % across, chunk.tile / across));
    }
    channels.put(pass, instances + first, count, L::kThreads);
    for (int k = threadIdx.x; k < L::kWarps * kBatch * kValues; k += L::kThreads) sums[k] = 0;
    __syncthreads();
    if (first < pixels.furthest)
      for (unsigned hits = reached_by_warp(batch, at, 0, count); hits;) {
        const int k = 31 - __clz(hits);
        hits &= ~(1u << k);
        splat_gradient<kAbsolute>(batch, channels, pixels, pass, at, k, first, transmittance, behind,
                                  own + k * kValues);
      }
    __syncthreads();
    write_rows<kRays, kWidth, kAbsolute>(sums, row_of, count, pass.count, rows);
  }
}

// Sums each splat's rows of a pass, a thread for each channel.
template <int kWidth>
__global__ void __launch_bounds__(256)
    sum_channels_kernel(const int32_t* halted, int64_t count, RowPlaces places, const float* rows,
                        const SplatSlots* slots, Channels<float> pass, float* to) {
  if (!begin_work(halted)) return;
  const int64_t splat = (int64_t(blockIdx.x) * 256 + threadIdx.x) / kWidth;
  const int channel = threadIdx.x % kWidth;
  if (splat >= count || channel >= pass.count) return;
  const int64_t begin = places.row(slots[splat].first), end = places.row(slots[splat + 1].first);
  constexpr int kTogether = 4;  // rows whose loads do not wait for each other, and whose sums grow apart
  float sums[kTogether] = {};
  for (int64_t row = begin; row < end; row += kTogether)
#pragma unroll
    for (int i = 0; i < kTogether; ++i)
      if (row + i < end) sums[i] += rows[kWidth * (row + i) + channel];
  to[splat * pass.stride + channel] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

template <int kRays, bool kAbsolute>
void run_passes(const Queue& queue, const BlendInput<float>& in, const Channels<float>& channels,
                const BlendGradient<float>& g, const RowMemory<float>& memory, float* values) {
  const int32_t chunk_size = tiles_of(in.image) <= kFewTiles ? kChunkOfFew : kChunkOfMany;
  const auto found = find_processed(queue, in, g, chunk_size, false);
  float* const shapes = memory.take(memory.context, found.rows);
  Layer* layers = queue.array<Layer>(size_t(found.schedule.places) * kTile * kTile);
  const int64_t widest = channels.count > 16 ? kMostChannels : 16;
  float* const sums = values ? queue.array<float>(size_t(found.rows) * widest) : nullptr;
  each_pass(channels, in, [&](int64_t first, const Channels<float>& pass, const BlendInput<float>& own, int64_t plane) {
    BlendGradient<float> gradient = g;
    gradient.color += plane;
    if (first > 0) gradient.transmittance_gradient = nullptr;
    by_width(pass.count, [&](auto width) {
      if (found.schedule.places)
        launch(queue, "channel_layers", channel_layers_kernel<kRays, width>, found.schedule.blocks, Layout<2>::kThreads,
               own, pass, gradient, found.schedule.chunks, layers);
      launch(queue, "channels_vjp", channels_vjp_kernel<kRays, width, kAbsolute>, found.schedule.blocks,
             LayoutOf<width>::kThreads, own, pass, gradient, found.lengths, found.schedule.chunks, int(chunk_size),
             layers, PassRows{found.places, shapes, sums, first > 0});
      if (values && g.count)
        launch(queue, "sum_channels", sum_channels_kernel<width>, blocks_for(g.count * width, 256), 256, g.count,
               found.places, sums, g.slots, pass, values + first);
    });
  });
  if (g.count) count_rows(queue, g.count, found.places, g.slots, memory.counts);
}

}  // namespace

template <>
void channel_rows<float>(const Queue& queue, const BlendInput<float>& in, const Channels<float>& channels,
                         const BlendGradient<float>& g, const RowMemory<float>& memory, float* values) {
  const auto run = in.rays ? (memory.absolute ? run_passes<kPinholeRays, true> : run_passes<kPinholeRays, false>)
                           : (memory.absolute ? run_passes<kNoRays, true> : run_passes<kNoRays, false>);
  run(queue, in, channels, g, memory, values);
}

}  // namespace cuda
}  // namespace gs
