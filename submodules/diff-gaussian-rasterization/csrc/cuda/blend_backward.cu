// The backward of blending. A tile's list is cut into chunks, a block each, because one long list would outlast all
// others together. Layers tell a chunk what lies behind it. In images of few tiles the forward has made them; else they
// are made first, one of every chunk.
#include "../backend.h"
#include "../math/slots.h"
#include "behind.cuh"
#include "blend_layers.cuh"
#include "blend_layout.cuh"
#include "gradient_rows.cuh"
#include "pixel_sums.cuh"
#include "processed.cuh"

namespace gs {
namespace cuda {

namespace {

// Splats of a chunk, in an image of few tiles and of many. Shorter chunks fill a GPU better, but each costs a layer.
constexpr int kChunkOfFew = kLayerChunk, kChunkOfMany = 512;

// Going back to front, a splat costs a warp as much as several pixels. So a lane takes 4, even if few warps run.
using Backward = Layout<4>;

// Values that a lane sums: kGradientRow, and perhaps kAbsoluteValues.
template <int kRays, bool kAbsolute>
constexpr int kSums = kGradientRow<kRays> + (kAbsolute ? kAbsoluteValues : 0);

// Sums ten values over a warp in 12 shuffles, twelve in 13, or up to sixteen in 16: each step halves the values that a
// lane keeps and doubles the lanes that are summed. The lane ends with the sum of `value`, or with none (-1).
template <int kCount>
__device__ __forceinline__ float transposed_sum(const float (&v)[kCount], int& value) {
  constexpr int kHalf = kCount / 2, kQuarter = (kHalf + 1) / 2;
  static_assert(kCount == 2 * kHalf && (kQuarter == 3 || kQuarter == 4), "quarters are cut into parts of 2 and 1");
  const int lane = threadIdx.x % 32;
  const bool b16 = lane & 16, b8 = lane & 8, b4 = lane & 4, b2 = lane & 2;
  float a[kHalf], b[kQuarter], c[2];
#pragma unroll
  for (int i = 0; i < kHalf; ++i)
    a[i] = (b16 ? v[i + kHalf] : v[i]) + __shfl_xor_sync(kWarp, b16 ? v[i] : v[i + kHalf], 16);
#pragma unroll
  for (int i = 0; i < kQuarter; ++i) {
    const float high = i + kQuarter < kHalf ? a[i + kQuarter] : 0;
    b[i] = (b8 ? high : a[i]) + __shfl_xor_sync(kWarp, b8 ? a[i] : high, 8);
  }
#pragma unroll
  for (int i = 0; i < 2; ++i) {
    const float high = i + 2 < kQuarter ? b[i + 2] : 0;
    c[i] = (b4 ? high : b[i]) + __shfl_xor_sync(kWarp, b4 ? b[i] : high, 4);
  }
  float sum = (b2 ? c[1] : c[0]) + __shfl_xor_sync(kWarp, b2 ? c[0] : c[1], 2);
  sum += __shfl_xor_sync(kWarp, sum, 1);
  const bool fourth = b4 && b2;
  const int in_quarter = b4 ? 2 + (kQuarter > 3 && b2) : b2, within = (b8 ? kQuarter : 0) + in_quarter;
  const bool exists = !(lane & 1) && !(kQuarter == 3 && fourth) && within < kHalf;
  value = exists ? (b16 ? kHalf : 0) + within : -1;
  return sum;
}

// The backward's inputs at a lane's pixels. Positions count from the chunk's first splat, which saves a register.
template <class L, bool kDepth>
struct Pixels {
  float red[L::kRun], green[L::kRun], blue[L::kRun], depth[L::kRun];  // image gradients
  float background[L::kRun], transmittance[L::kRun];                  // of the background: its value, its share
  int last[L::kRun], furthest;                                        // furthest: the warp's largest

  __device__ Pixels(const BlendInput<float>& in, const BlendGradient<float>& g, const L& at, int left, int top,
                    int first) {
    const int64_t plane = int64_t(in.image.width) * in.image.height;
    furthest = 0;
    for (int p = 0; p < L::kRun; ++p) {
      const int x = left + at.x + at.column(p), y = top + at.y;
      const bool inside = x < in.image.width && y < in.image.height;
      const int64_t pixel = inside ? int64_t(y) * in.image.width + x : 0;
      transmittance[p] = inside ? g.transmittance[pixel] : 1;
      last[p] = inside ? g.last[pixel] - first : 0;
      red[p] = inside ? g.color[pixel] : 0;
      green[p] = inside ? g.color[plane + pixel] : 0;
      blue[p] = inside ? g.color[2 * plane + pixel] : 0;
      depth[p] = kDepth && inside ? g.inverse_depth[pixel] : 0;
      background[p] = in.background[0] * red[p] + in.background[1] * green[p] + in.background[2] * blue[p];
      if (g.transmittance_gradient && inside) background[p] += g.transmittance_gradient[pixel];
      furthest = last[p] > furthest ? last[p] : furthest;
    }
    furthest = warp_max(furthest);
  }

  __device__ float value(int p, const float4& color, float inverse_depth) const {
    const float sum = color.x * red[p] + color.y * green[p] + color.z * blue[p];
    return kDepth ? sum + inverse_depth * depth[p] : sum;
  }
};

// Computes the layers of all chunks but the first of each tile, a block each.
template <class L, int kRays, bool kDepth>
__global__ void __launch_bounds__(L::kThreads)
    layers_kernel(const int32_t* halted, BlendInput<float> in, BlendGradient<float> g, const Chunk* chunks,
                  Layer* layers) {
  if (!begin_work(halted)) return;
  constexpr int kBatch = L::kThreads, kRun = L::kRun;
  __shared__ Batch<kBatch, kRays> batch;
  const Chunk chunk = chunks[blockIdx.x];
  if (chunk.tile < 0 || chunk.first == 0) return;
  const PlacesOf<L, kRays> at(in, chunk.tile);
  const int across = tile_count(in.image.width);
  const int left = chunk.tile % across * kTile, top = chunk.tile / across * kTile;
  const Pixels<L, kDepth> pixels(in, g, at, left, top, chunk.first);
  float value[kRun], transmittance[kRun];
  for (int p = 0; p < kRun; ++p) value[p] = 0, transmittance[p] = 1;
  const int64_t begin = in.ranges[chunk.tile] + chunk.first;
  const int length = chunk.end - chunk.first, mine = threadIdx.x;
  for (int first = 0; first < length; first += kBatch) {
    const int count = length - first < kBatch ? length - first : kBatch;
    __syncthreads();
    if (mine < count) batch.put(mine, in, chunk.tile, in.instances[begin + first + mine], float(left), float(top));
    __syncthreads();
    for (int from = 0; from < count && first + from < pixels.furthest; from += 32)
      front_to_back(batch, at, from, count, [&](int k, int p, float t) {
        const bool blended = t >= kLeast && first + k < pixels.last[p];
        if (kTogether<L> == 1 && !blended) return;
        const float weight = capped<float, float>(exp2_device(t)) * transmittance[p];
        const float seen = weight * pixels.value(p, batch.color[k], batch.rest[k].w);
        if (blended) value[p] += seen, transmittance[p] -= weight;
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

using OfPixels = float[Backward::kRun];  // a value for each of a lane's pixels

// Starts as start_behind, from the forward's layers, of which one stands for all that lies behind the chunk. length:
// the chunk's.
template <bool kDepth>
__device__ __forceinline__ void start_before(const Pixels<Backward, kDepth>& pixels, const Backward& at,
                                             const MadeLayers& layers, int64_t layer, int length,
                                             OfPixels& transmittance, OfPixels& behind) {
  for (int p = 0; p < Backward::kRun; ++p) {
    transmittance[p] = pixels.transmittance[p], behind[p] = pixels.background[p];
    if (pixels.last[p] <= length) continue;  // the layer is not there, or shows nothing at this pixel
    const int64_t pixel = layer + at.y * kTile + at.x + at.column(p);
    const float4 color = layers.color[pixel];
    const float value = pixels.value(p, color, kDepth ? layers.depth[pixel] : 0);
    behind[p] = (value + pixels.transmittance[p] * pixels.background[p]) / color.w;
    transmittance[p] = color.w;
  }
}

// Steps the lanes over splat k of the batch, whose first splat is the chunk's splat `first`, and leaves the sums over
// the warp's pixels in `sums`. A splat that reaches none of them changes nothing.
template <bool kDepth, bool kAbsolute, int kBatch, int kRays>
__device__ __forceinline__ void splat_gradient(const Batch<kBatch, kRays>& batch,
                                               const Pixels<Backward, kDepth>& pixels,
                                               const PlacesOf<Backward, kRays>& at, int k, int first,
                                               OfPixels& transmittance, OfPixels& behind, float* sums) {
  const auto splat = batch.local(k);
  const float4 c = batch.color[k];
  const auto row = terms_of(splat, at.y);
  LaneMoments<kRays> moments;
  float r = 0, gr = 0, b = 0, d = 0, absolute_u = 0, absolute_uv = 0;
  bool any = false;
#pragma unroll
  for (int p = 0; p < Backward::kRun; ++p) {
    const auto here = at_pixel(row, at.place(p));
    const float t = row_exponent(row, here);
    if (!(t >= kLeast) || first + k >= pixels.last[p]) continue;
    any = true;
    const float uncapped = exp2_device(t), alpha = capped<float, float>(uncapped);
    const float value = pixels.value(p, c, splat.inverse_depth);
    const float q = uncapped * alpha_gradient<float, float>(alpha, value, transmittance[p], behind[p]);
    const float weight = alpha * transmittance[p];
    add_pixel(moments, row, here, q);
    r += weight * pixels.red[p], gr += weight * pixels.green[p], b += weight * pixels.blue[p];
    if (kDepth) d += weight * pixels.depth[p];
    if (kAbsolute) {
      const float2 by = pull(splat, row, here);
      absolute_u += fabsf(q * by.x), absolute_uv += fabsf(q * (splat.l12 * by.x + splat.l22 * by.y));
    }
  }
  if (!__any_sync(kWarp, any)) return;
  constexpr int kRow = kSums<kRays, kAbsolute>;
  float v[kRow];
  const auto keep = [&](const auto& all) {
#pragma unroll
    for (int i = 0; i < kRow; ++i) v[i] = all[i];
  };
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
  int value;
  const float sum = transposed_sum(v, value);
  if (value >= 0) sums[(threadIdx.x / 32 * kBatch + k) * kRow + value] = sum;
}

// Walks each chunk back to front, a block each, and writes its gradient rows. Within these registers ptxas compiles the
// loop over splats without spills on sm_90. If blocks per multiprocessor are bounded instead, it makes the loop a tenth
// longer.
template <int kRays, bool kDepth, bool kMade, bool kAbsolute>
__global__ void GS_MAX_REGISTERS((kDepth ? 96 : 80) + (kAbsolute ? 8 : 0) + (kRays ? 16 : 0) +
                                 (kRays == kLensRays ? 24 : 0))
    blend_vjp_kernel(const int32_t* halted, BlendInput<float> in, BlendGradient<float> g, const int32_t* processed,
                     const Chunk* chunks, int chunk_size, const Layer* layers, MadeLayers made,
                     GradientRows<kRays> rows, float* absolute) {
  if (!begin_work(halted)) return;
  using L = Backward;
  constexpr int kBatch = 64, kRow = kSums<kRays, kAbsolute>;
  __shared__ Batch<kBatch, kRays> batch;
  __shared__ float sums[L::kWarps * kBatch * kRow];
  __shared__ int64_t row_of[kBatch];
  const Chunk chunk = chunks[blockIdx.x];
  if (chunk.tile < 0) return;
  const PlacesOf<L, kRays> at(in, chunk.tile);
  const int across = tile_count(in.image.width);
  const int left = chunk.tile % across * kTile, top = chunk.tile / across * kTile;
  const Pixels<L, kDepth> pixels(in, g, at, left, top, chunk.first);
  OfPixels transmittance, behind, through;
  int64_t begin = in.ranges[chunk.tile];
  if (kMade) {
    const int64_t layer = layer_pixel(begin, chunk.first / kLayerChunk + 1);
    start_before(pixels, at, made, layer, chunk.end - chunk.first, transmittance, behind);
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
      row_of[k] = rows.row(slot_of(g.slots, splat, chunk.tile % across, chunk.tile / across));
    }
    for (int k = threadIdx.x; k < L::kWarps * kBatch * kRow; k += L::kThreads) sums[k] = 0;
    __syncthreads();
    for (int from = (count - 1) / 32 * 32; from >= 0; from -= 32) {
      if (first + from >= pixels.furthest) continue;
      unsigned hits = reached_by_warp(batch, at, from, count);
      while (hits) {
        const int bit = 31 - __clz(hits), k = from + bit;
        hits &= ~(1u << bit);
        splat_gradient<kDepth, kAbsolute>(batch, pixels, at, k, first, transmittance, behind, sums);
      }
    }
    __syncthreads();
    for (int k = threadIdx.x; k < count * kRow; k += L::kThreads) {
      float sum = 0;
      for (int w = 0; w < L::kWarps; ++w) sum += sums[w * kBatch * kRow + k];
      const int64_t row = row_of[k / kRow];
      const int value = k % kRow;
      if (!kAbsolute || value < kGradientRow<kRays>)
        rows.values[kGradientRow<kRays> * row + value] = sum;
      else
        absolute[kAbsoluteValues * row + value - kGradientRow<kRays>] = sum;
    }
  }
}

template <int kRays>
__global__ void __launch_bounds__(256)
    moments_kernel(const int32_t* halted, int64_t count, SlotSums<kRays> sums, float* moments) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * 256 + threadIdx.x;
  constexpr int kRow = kGradientRow<kRays>, kStage = SlotSums<kRays>::kStage;
  __shared__ __align__(8) float stage[256 / 32 * kStage];
  float values[kRow];
  sums.read(i, i < count && sums.seen(i), values, stage + threadIdx.x / 32 * kStage);
  if (i >= count) return;
  for (int v = 0; v < kRow; ++v) moments[kRow * i + v] = values[v];
}

template <class L, int kRays>
void find_layers(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g,
                 const Schedule& schedule, Layer* layers) {
  const auto kernel = g.inverse_depth ? layers_kernel<L, kRays, true> : layers_kernel<L, kRays, false>;
  launch(queue, "layers", kernel, schedule.blocks, L::kThreads, in, g, schedule.chunks, layers);
}

// The kernel that blends back to front, for what is wanted and what is there.
template <int kRays, bool kAbsolute>
auto blend_vjp_kernel_for(bool depth, bool made) {
  return depth
             ? (made ? blend_vjp_kernel<kRays, true, true, kAbsolute> : blend_vjp_kernel<kRays, true, false, kAbsolute>)
             : (made ? blend_vjp_kernel<kRays, false, true, kAbsolute>
                     : blend_vjp_kernel<kRays, false, false, kAbsolute>);
}

// Runs the backward up to the rows. take: allocates those of the gradients, for their number, for which the host waits
// if `exact`, else perhaps for more.
template <int kRays, class Take>
FilledRows<kRays> blend_back(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g,
                             bool absolute, bool exact, const Take& take) {
  const bool few = tiles_of(in.image) <= kFewTiles;
  const int chunk_size = few ? kChunkOfFew : kChunkOfMany;
  const auto [places, processed, schedule, rows] = find_processed(queue, in, g, chunk_size, exact);
  const GradientRows<kRays> gradients{places, take(rows)};
  const bool made = g.layers && makes_layers(in.image);
  Layer* layers = queue.array<Layer>(made ? 0 : size_t(schedule.places) * kTile * kTile);
  if (schedule.places && !made)
    (few ? find_layers<Layout<1>, kRays> : find_layers<Layout<2>, kRays>)(queue, in, g, schedule, layers);
  const AbsoluteRows lengths{places, queue.array<float>(absolute ? size_t(rows) * kAbsoluteValues : 0)};
  const bool depth = g.inverse_depth;
  const auto kernel =
      absolute ? blend_vjp_kernel_for<kRays, true>(depth, made) : blend_vjp_kernel_for<kRays, false>(depth, made);
  launch(queue, "blend_vjp", kernel, schedule.blocks, Backward::kThreads, in, g, processed, schedule.chunks, chunk_size,
         layers, layers_at(g.layers, in.instance_count), gradients, lengths.values);
  queue.release(queue.context, layers), queue.release(queue.context, schedule.chunks);
  return {gradients, lengths};
}

template <int kRays>
void keep_rows(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g,
               const RowMemory<float>& memory) {
  float* rows = nullptr;
  int64_t count = 0;
  const auto filled = blend_back<kRays>(queue, in, g, memory.absolute, true, [&](int64_t exact) {
    count = exact, rows = memory.take(memory.context, exact);
    return memory.absolute ? queue.array<float>(size_t(exact) * kGradientRow<kRays>) : rows;
  });
  if (g.count) count_rows(queue, g.count, filled.gradients, g.slots, memory.counts);
  if (memory.absolute) join_rows(queue, count, filled, rows);
}

template <int kRays>
void sum_moments(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g) {
  const SlotSums<kRays> sums{fill_rows<kRays>(queue, in, g), g.slots};
  launch(queue, "moments", moments_kernel<kRays>, blocks_for(g.count, 256), 256, g.count, sums, g.moments);
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

template <>
void blend_vjp<float>(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g) {
  const auto sum = in.rays == kLensRays ? sum_moments<kLensRays>
                   : in.rays            ? sum_moments<kPinholeRays>
                                        : sum_moments<kNoRays>;
  if (g.count) sum(queue, in, g);
}

}  // namespace cuda
}  // namespace gs
