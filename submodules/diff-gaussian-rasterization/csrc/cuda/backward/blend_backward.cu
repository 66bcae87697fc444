// The backward of blending. A tile's list is cut into chunks, a block each, because one long list would outlast all
// others together. Layers tell a chunk what lies behind it. In images of few tiles the forward has made those of
// colours; else they are made first, one of every chunk.
#include "behind.cuh"
#include "cuda/blend/blend_layers.cuh"
#include "cuda/blend/payload.cuh"
#include "gradient_rows.cuh"
#include "math/slots.h"
#include "pixel_sums.cuh"
#include "processed.cuh"

namespace gs {
namespace cuda {

namespace {

// Splats of a chunk, in an image of few tiles and of many. Shorter chunks fill a GPU better, but each costs a layer.
constexpr int kChunkOfFew = kLayerChunk, kChunkOfMany = 512;

// Going back to front, a splat costs a warp as much as several pixels. So a lane takes 4, even if few warps run; it
// takes 2 where each takes many registers.
template <class P>
using Backward = Layout<(P::kWide ? 2 : 4)>;
template <class P>
constexpr int kRowBatch = P::kWide ? 32 : 64;  // splats whose rows are written at once
template <class P>
using OfPixels = float[Backward<P>::kRun];  // a value for each of a lane's pixels

// Values that a lane sums: kGradientRow and perhaps kAbsoluteValues, where the first four channels stand in place of a
// colour and an inverse depth; then further channels.
constexpr int kMoments = kGradientValues - 4;
template <int kRays, bool kAbsolute>
constexpr int kRow = kGradientRow<kRays> + (kAbsolute ? kAbsoluteValues : 0);
template <class P>
constexpr int kFurther = P::kWide ? P::kWidth - 4 : 0;

// Computes the layers of all chunks but the first of each tile, a block each.
template <class L, int kRays, class P>
__global__ void __launch_bounds__(L::kThreads)
    layers_kernel(const int32_t* halted, BlendInput<float> in, BlendGradient<float> g, const Chunk* chunks,
                  Layer* layers) {
  if (!begin_work(halted)) return;
  constexpr int kBatch = L::kThreads, kRun = L::kRun;
  __shared__ PayloadBatch<kBatch, kRays, P> batch;
  const Chunk chunk = chunks[blockIdx.x];
  if (chunk.tile < 0 || chunk.first == 0) return;
  const PlacesOf<L, kRays> at(in, chunk.tile);
  const int across = tile_count(in.image.width);
  const int left = chunk.tile % across * kTile, top = chunk.tile / across * kTile;
  const Pixels<L, P> pixels(in, g, at, left, top, chunk.first);
  float value[kRun], transmittance[kRun];
  for (int p = 0; p < kRun; ++p) value[p] = 0, transmittance[p] = 1;
  const int64_t begin = in.ranges[chunk.tile] + chunk.first;
  const int length = chunk.end - chunk.first, mine = threadIdx.x;
  for (int first = 0; first < length; first += kBatch) {
    const int count = length - first < kBatch ? length - first : kBatch;
    __syncthreads();
    if (mine < count) batch.put(mine, in, chunk.tile, in.instances[begin + first + mine], float(left), float(top));
    batch.put_channels(in, in.instances + begin + first, count, L::kThreads);
    __syncthreads();
    for (int from = 0; from < count && first + from < pixels.furthest; from += 32)
      front_to_back(batch, at, from, count, [&](int k, const float (&t)[kRun]) {
        if (P::kWide && !pixels.blended(first + k, t)) return;
        const auto value_of = pixels.value_of(batch, k);
#pragma unroll
        for (int p = 0; p < kRun; ++p) {
          const bool blended = t[p] >= kLeast && first + k < pixels.last[p];
          if (kTogether<L> == 1 && !blended) continue;
          const float weight = capped<float, float>(exp2_device(t[p]), P::cap(in)) * transmittance[p];
          const float seen = weight * value_of(p);
          if (blended) value[p] += seen, transmittance[p] -= weight;
        }
      });
  }
  Layer* to = layers + int64_t(kTile * kTile) * (chunk.behind - 1) + at.y * kTile + at.x;
  for (int p = 0; p < kRun; ++p) to[at.column(p)] = {value[p], transmittance[p]};
}

// CUDA has this from 12.4 on; without it the kernel takes more registers.
#if __CUDACC_VER_MAJOR__ > 12 || (__CUDACC_VER_MAJOR__ == 12 && __CUDACC_VER_MINOR__ >= 4)
#define GS_MAX_REGISTERS(count) __maxnreg__(count)
#else
#define GS_MAX_REGISTERS(count)
#endif

template <int kRays, class P, bool kAbsolute>
constexpr int kRegisters =
    P::kWide ? 128
             : (P::kWidth == 4 ? 96 : 80) + (kAbsolute ? 8 : 0) + (kRays ? 16 : 0) + (kRays == kLensRays ? 24 : 0);

// Starts as start_behind, from the forward's layers, of which one stands for all that lies behind the chunk. length:
// the chunk's.
template <class P, class L>
__device__ __forceinline__ void start_before(const Pixels<L, P>& pixels, const L& at, const MadeLayers& layers,
                                             int64_t layer, int length, OfPixels<P>& transmittance,
                                             OfPixels<P>& behind) {
  for (int p = 0; p < L::kRun; ++p) {
    transmittance[p] = pixels.transmittance[p], behind[p] = pixels.background[p];
    if (pixels.last[p] <= length) continue;  // the layer is not there, or shows nothing at this pixel
    const int64_t pixel = layer + at.y * kTile + at.x + at.column(p);
    const float4 color = layers.color[pixel];
    const float value = pixels.value(p, make_float4(color.x, color.y, color.z, P::kDepth ? layers.depth[pixel] : 0));
    behind[p] = (value + pixels.transmittance[p] * pixels.background[p]) / color.w;
    transmittance[p] = color.w;
  }
}

// Leaves a gradient row's sums over the warp's pixels in `sums`.
template <bool kAbsolute, int kRays, class Row, class Splat>
__device__ __forceinline__ void sum_row(const LaneMoments<kRays>& moments, const Row& row, const Splat& splat,
                                        const float (&payload)[4], float absolute_u, float absolute_uv, float* sums) {
  float v[kRow<kRays, kAbsolute>];
  const auto keep = [&](const auto& all) {
#pragma unroll
    for (int i = 0; i < kRow<kRays, kAbsolute>; ++i) v[i] = all[i];
  };
  const auto& [r, gr, b, d] = payload;
  if constexpr (kRays != kNoRays) {
    const RayMoments<float> rays = moments.moments(row, splat);
    const Moments<float>& m = rays.on_image;
    const float all[] = {m.q, m.qu, m.qv,    m.quu,   m.quv,   m.qvv, r,          gr,
                         b,   d,    rays.pu, rays.pv, rays.pp, 0,     absolute_u, absolute_uv};
    keep(all);
  } else {
    const Moments<float> m = moments.moments(row);
    const float all[] = {m.q, m.qu, m.qv, m.quu, m.quv, m.qvv, r, gr, b, d, absolute_u, absolute_uv};
    keep(all);
  }
  warp_sums(v, sums);
}

// Steps the lanes over splat k of the batch, whose first splat is the chunk's splat `first`, and leaves the sums over
// the warp's pixels in `sums`. A splat that reaches none of them changes nothing.
template <bool kAbsolute, class P, int kBatch, int kRays>
__device__ __forceinline__ void splat_gradient(const BlendInput<float>& in, const PayloadBatch<kBatch, kRays, P>& batch,
                                               const Pixels<Backward<P>, P>& pixels,
                                               const PlacesOf<Backward<P>, kRays>& at, int k, int first,
                                               OfPixels<P>& transmittance, OfPixels<P>& behind, float* sums) {
  constexpr int kRun = Backward<P>::kRun;
  const auto splat = batch.local(k);
  const auto row = terms_of(splat, at.y);
  if (P::kWide) {
    OfPixels<P> exponent;
#pragma unroll
    for (int p = 0; p < kRun; ++p) exponent[p] = row_exponent(row, at_pixel(row, at.place(p)));
    if (!pixels.blended(first + k, exponent)) return;
  }
  const auto value_of = pixels.value_of(batch, k);
  LaneMoments<kRays> moments;
  float payload[4] = {}, absolute_u = 0, absolute_uv = 0;
  OfPixels<P> weight = {};
  bool any = false;
#pragma unroll
  for (int p = 0; p < kRun; ++p) {
    const auto here = at_pixel(row, at.place(p));
    const float t = row_exponent(row, here);
    if (!(t >= kLeast) || first + k >= pixels.last[p]) continue;
    any = true;
    const float uncapped = exp2_device(t), alpha = capped<float, float>(uncapped, P::cap(in));
    float q = uncapped * alpha_gradient<float, float>(true, alpha, value_of(p), transmittance[p], behind[p]);
    if (P::kChannels && in.channels.stops && uncapped > alpha) q = 0;
    weight[p] = alpha * transmittance[p];
    add_pixel(moments, row, here, q);
#pragma unroll
    for (int c = 0; c < 4 && c < P::kWidth; ++c)
      if (!P::kWide) payload[c] += weight[p] * pixels.gradient[p][c];
    if (kAbsolute) {
      const float2 by = pull(splat, row, here);
      absolute_u += fabsf(q * by.x), absolute_uv += fabsf(q * (splat.l12 * by.x + splat.l22 * by.y));
    }
  }
  if (!P::kWide && !__any_sync(kWarp, any)) return;
  if constexpr (P::kWide)
#pragma unroll
    for (int c = 0; c < 4; ++c)
#pragma unroll
      for (int p = 0; p < kRun; ++p)
        if (weight[p] > 0) payload[c] += weight[p] * pixels.gradient[p][c];  // which may not be finite elsewhere
  sum_row<kAbsolute, kRays>(moments, row, splat, payload, absolute_u, absolute_uv, sums);
  if constexpr (kFurther<P> > 0) {
    constexpr int kGroup = kFurther<P> > 16 ? kFurther<P> / 2 : kFurther<P>;  // a lane's registers hold no more sums
#pragma unroll
    for (int c = 0; c < kFurther<P>; c += kGroup) {
      float group[kGroup] = {};
#pragma unroll
      for (int i = 0; i < kGroup; ++i)
#pragma unroll
        for (int p = 0; p < kRun; ++p)
          if (weight[p] > 0) group[i] += weight[p] * pixels.gradient[p][4 + c + i];
      warp_sums(group, sums + kRow<kRays, kAbsolute> + c);
    }
  }
}

// Where a kernel's sums go. Of channels, (rows, kWidth) or null; adds: whether there are sums of other passes.
template <int kRays>
struct OutRows {
  GradientRows<kRays> gradients;
  float *absolute, *channels;
  bool adds;

  template <class P, bool kAbsolute>
  __device__ __forceinline__ void put(int64_t row, int value, float sum) const {
    if (P::kChannels) {
      const int further = value - kRow<kRays, kAbsolute>, channel = further < 0 ? value - kMoments : further + 4;
      const bool is_channel = channel >= 0 && (channel < 4 || further >= 0);
      if (is_channel && channels) channels[P::kWidth * row + channel] = sum;
      if (is_channel && (adds || channel > 3)) return;
      if (channel == 3) sum = 0;  // not an inverse depth
    }
    float* const to = !kAbsolute || value < kGradientRow<kRays>
                          ? gradients.values + kGradientRow<kRays> * row + value
                          : absolute + kAbsoluteValues * row + value - kGradientRow<kRays>;
    *to = P::kChannels && adds ? *to + sum : sum;
  }
};

// Walks each chunk back to front, a block each, and writes its gradient rows. Within these registers ptxas compiles the
// loop over splats without spills on sm_90. If blocks per multiprocessor are bounded instead, it makes the loop a tenth
// longer.
template <int kRays, class P, bool kMade, bool kAbsolute>
__global__ void GS_MAX_REGISTERS((kRegisters<kRays, P, kAbsolute>))
    blend_vjp_kernel(const int32_t* halted, BlendInput<float> in, BlendGradient<float> g, const int32_t* processed,
                     const Chunk* chunks, int chunk_size, const Layer* layers, MadeLayers made, OutRows<kRays> out) {
  if (!begin_work(halted)) return;
  using L = Backward<P>;
  constexpr int kBatch = kRowBatch<P>, kSums = kRow<kRays, kAbsolute> + kFurther<P>;
  __shared__ PayloadBatch<kBatch, kRays, P> batch;
  __shared__ float sums[L::kWarps * kBatch * kSums];
  __shared__ int64_t row_of[kBatch];
  const Chunk chunk = chunks[blockIdx.x];
  if (chunk.tile < 0) return;
  const PlacesOf<L, kRays> at(in, chunk.tile);
  const int across = tile_count(in.image.width);
  const int left = chunk.tile % across * kTile, top = chunk.tile / across * kTile;
  const Pixels<L, P> pixels(in, g, at, left, top, chunk.first);
  OfPixels<P> transmittance, behind, through;
  int64_t begin = in.ranges[chunk.tile];
  if constexpr (kMade) {
    const int64_t layer = layer_pixel(begin, chunk.first / kLayerChunk + 1);
    start_before<P, L>(pixels, at, made, layer, chunk.end - chunk.first, transmittance, behind);
  } else {
    const int layers_behind = (processed[chunk.tile] - chunk.end + chunk_size - 1) / chunk_size;
    start_behind(pixels, at, layers, chunk.behind, layers_behind, transmittance, behind, through);
  }
  begin += chunk.first;
  for (int end = chunk.end - chunk.first; end > 0; end -= kBatch) {
    const int count = end < kBatch ? end : kBatch, first = end - count;
    __syncthreads();
    for (int k = threadIdx.x; k < count; k += L::kThreads) {
      const int32_t splat = in.instances[begin + first + k];
      batch.put(k, in, chunk.tile, splat, float(left), float(top));
      row_of[k] = out.gradients.row(slot_of(g.slots, splat, chunk.tile % across, chunk.tile / across));
    }
    batch.put_channels(in, in.instances + begin + first, count, L::kThreads);
    for (int k = threadIdx.x; k < L::kWarps * kBatch * kSums; k += L::kThreads) sums[k] = 0;
    __syncthreads();
    for (int from = (count - 1) / 32 * 32; from >= 0; from -= 32) {
      if (first + from >= pixels.furthest) continue;
      unsigned hits = reached_by_warp(batch, at, from, count);
      while (hits) {
        const int bit = 31 - __clz(hits), k = from + bit;
        hits &= ~(1u << bit);
        splat_gradient<kAbsolute>(in, batch, pixels, at, k, first, transmittance, behind,
                                  sums + (threadIdx.x / 32 * kBatch + k) * kSums);
      }
    }
    __syncthreads();
    for (int k = threadIdx.x; k < count * kSums; k += L::kThreads) {
      float sum = 0;
      for (int w = 0; w < L::kWarps; ++w) sum += sums[w * kBatch * kSums + k];
      out.template put<P, kAbsolute>(row_of[k / kSums], k % kSums, sum);
    }
  }
}

// Sums each splat's rows of a pass, a thread for each channel.
template <int kWidth>
__global__ void __launch_bounds__(256)
    sum_channels_kernel(const int32_t* halted, int64_t count, RowPlaces places, const float* rows,
                        const SplatSlots* slots, int64_t channels, int64_t columns, float* to) {
  if (!begin_work(halted)) return;
  const int64_t splat = (int64_t(blockIdx.x) * 256 + threadIdx.x) / kWidth;
  const int channel = threadIdx.x % kWidth;
  if (splat >= count || channel >= channels) return;
  const int64_t begin = places.row(slots[splat].first), end = places.row(slots[splat + 1].first);
  constexpr int kTogether = 4;  // rows whose loads do not wait for each other, and whose sums grow apart
  float sums[kTogether] = {};
  for (int64_t row = begin; row < end; row += kTogether)
#pragma unroll
    for (int i = 0; i < kTogether; ++i)
      if (row + i < end) sums[i] += rows[kWidth * (row + i) + channel];
  to[splat * columns + channel] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

// What the rows are made from.
struct Source {
  const BlendInput<float>& in;
  const BlendGradient<float>& gradient;
  const Processed& found;
  int chunk_size;
  Layer* layers;
  bool made;  // the forward has made layers
};

// Computes the layers that lack, and the rows.
template <class P, int kRays>
void fill_rows_of(const Queue& queue, const Source& from, bool absolute, const OutRows<kRays>& out) {
  const auto& [in, g, found, chunk_size, layers, made] = from;
  const Schedule& schedule = found.schedule;
  if (schedule.places && !made) {
    using Few = Layout<P::kWide ? 2 : 1>;
    const bool few = tiles_of(in.image) <= kFewTiles;
    launch(queue, "layers", few ? layers_kernel<Few, kRays, P> : layers_kernel<Layout<2>, kRays, P>, schedule.blocks,
           few ? Few::kThreads : Layout<2>::kThreads, in, g, schedule.chunks, layers);
  }
  auto kernel = absolute ? blend_vjp_kernel<kRays, P, false, true> : blend_vjp_kernel<kRays, P, false, false>;
  if constexpr (!P::kChannels)
    if (made) kernel = absolute ? blend_vjp_kernel<kRays, P, true, true> : blend_vjp_kernel<kRays, P, true, false>;
  launch(queue, "blend_vjp", kernel, schedule.blocks, Backward<P>::kThreads, in, g, found.lengths, schedule.chunks,
         chunk_size, layers, layers_at(g.layers, in.instance_count), out);
}

// The passes over channels.
template <int kRays>
void fill_passes(const Queue& queue, const Source& from, bool absolute, OutRows<kRays> out) {
  const BlendGradient<float>& g = from.gradient;
  float* const values = g.values_apart(from.in.channels) ? g.values : nullptr;
  const int64_t widest = from.in.channels.count > 16 ? kMostChannels : 16;
  out.channels = values ? queue.array<float>(size_t(from.found.rows) * widest) : nullptr;
  each_pass(from.in, [&](int64_t first, const BlendInput<float>& pass, int64_t plane) {
    BlendGradient<float> gradient = g;
    gradient.color += plane;
    if (first > 0) gradient.transmittance_gradient = nullptr;
    out.adds = first > 0;
    by_width(pass.channels.count, [&](auto payload) {
      using P = decltype(payload);
      fill_rows_of<P>(queue, {pass, gradient, from.found, from.chunk_size, from.layers, false}, absolute, out);
      if (values && g.count)
        launch(queue, "sum_channels", sum_channels_kernel<P::kWidth>, blocks_for(g.count * P::kWidth, 256), 256,
               g.count, from.found.places, out.channels, g.slots, pass.channels.count, from.in.channels.count,
               values + first);
    });
  });
}

// Runs the backward up to the rows. take: allocates those of the gradients, for their number, for which the host waits
// if `exact`, else perhaps for more.
template <int kRays, class Take>
FilledRows<kRays> blend_back(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g,
                             bool absolute, bool exact, const Take& take) {
  const int chunk_size = tiles_of(in.image) <= kFewTiles ? kChunkOfFew : kChunkOfMany;
  const Processed found = find_processed(queue, in, g, chunk_size, exact);
  const GradientRows<kRays> gradients{found.places, take(found.rows)};
  const bool made = g.layers && makes_layers(in.image);
  Layer* layers = queue.array<Layer>(made ? 0 : size_t(found.schedule.places) * kTile * kTile);
  const AbsoluteRows lengths{found.places, queue.array<float>(absolute ? size_t(found.rows) * kAbsoluteValues : 0)};
  const Source from{in, g, found, chunk_size, layers, made};
  const OutRows<kRays> out{gradients, lengths.values, nullptr, false};
  if (in.channels.count) {
    if constexpr (kRays != kLensRays) fill_passes<kRays>(queue, from, absolute, out);
  } else {
    (g.inverse_depth ? fill_rows_of<Colors<true>, kRays> : fill_rows_of<Colors<false>, kRays>)(queue, from, absolute,
                                                                                               out);
  }
  queue.release(queue.context, layers), queue.release(queue.context, found.schedule.chunks);
  return {gradients, lengths};
}

template <int kRays>
void keep_rows(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g,
               const RowMemory<float>& memory) {
  float* rows = nullptr;
  int64_t count = 0;
  const auto filled = blend_back<kRays>(queue, in, g, memory.absolute, true, [&](int64_t room) {
    count = room, rows = memory.take(memory.context, room);
    return memory.absolute ? queue.array<float>(size_t(room) * kGradientRow<kRays>) : rows;
  });
  if (g.count) count_rows(queue, g.count, filled.gradients, g.slots, memory.counts);
  if (memory.absolute) join_rows(queue, count, filled, rows);
}

}  // namespace

template <int kRays>
GradientRows<kRays> fill_rows(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g) {
  const FilledRows<kRays> rows = blend_back<kRays>(queue, in, g, g.absolute != nullptr, false, [&](int64_t count) {
    return queue.array<float>(size_t(count) * kGradientRow<kRays>);
  });
  if (g.absolute) find_lengths(queue, g.count, {rows.absolute, g.slots}, in.splats, kRays, in.image, g.absolute);
  queue.release(queue.context, rows.absolute.values);  // the gradients come next, and take most of a step's memory
  return rows.gradients;
}
template GradientRows<kNoRays> fill_rows<kNoRays>(const Queue&, const BlendInput<float>&, const BlendGradient<float>&);
template GradientRows<kPinholeRays> fill_rows<kPinholeRays>(const Queue&, const BlendInput<float>&,
                                                            const BlendGradient<float>&);
template GradientRows<kLensRays> fill_rows<kLensRays>(const Queue&, const BlendInput<float>&,
                                                      const BlendGradient<float>&);

template <>
void blend_rows<float>(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g,
                       const RowMemory<float>& memory) {
  (in.rays ? keep_rows<kPinholeRays> : keep_rows<kNoRays>)(queue, in, g, memory);
}

}  // namespace cuda
}  // namespace gs
