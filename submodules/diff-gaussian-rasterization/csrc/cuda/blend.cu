// A block per tile. A warp owns a sub-tile, a lane several pixels of a row, so that a splat's loads, the loop and the
// ballot are shared; 32 splats at a time are tested against the sub-tile, a lane each.
#include <cuda_runtime.h>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/cub.cuh>

#include "../launch.h"
#include "../math/blend.h"
#include "../math/exp2.h"
#include "../math/footprint.h"
#include "../math/tiles.h"
#include "backward.cuh"
#include "gs/cuda_check.h"
#include "heaviest.cuh"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

constexpr unsigned kWarp = 0xffffffffu;
constexpr float kLeast = float(kLog2MinAlpha);

cudaStream_t stream_of(const Queue& queue) { return static_cast<cudaStream_t>(queue.stream); }
int64_t tiles_of(Image image) { return int64_t(tile_count(image.width)) * tile_count(image.height); }

// Images of up to so many tiles do not fill a GPU with blocks, and wait for their longest lists: more warps share a
// tile.
constexpr int64_t kFewTiles = 4096;

// How a tile is shared out: a lane has kRun pixels of one row, 4 (or 8, if one) columns apart.
template <int kRun_>
struct Layout {
  static constexpr int kRun = kRun_;
  static constexpr int kColumns = kRun == 1 ? 8 : 4;  // lanes side by side
  static constexpr int kWide = kColumns * kRun, kHigh = 32 / kColumns;
  static constexpr int kAcross = kTile / kWide, kWarps = kTile * kTile / (kWide * kHigh);
  static constexpr int kThreads = 32 * kWarps;

  int left, top;  // of the warp's sub-tile, in the tile
  int x, y;       // of the lane's first pixel, in the tile
  __device__ Layout() {
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    left = warp % kAcross * kWide, top = warp / kAcross * kHigh;
    x = left + lane % kColumns, y = top + lane / kColumns;
  }
  __device__ static int column(int run) { return run * kColumns; }
};

// Up to here every instance gets a gradient row, 40 MiB at most, so that the host need not wait for the number of those
// that want one.
constexpr int64_t kRowsUnasked = 1 << 20;

using Backward = Layout<4>;

struct ListLength {
  const int64_t* ranges;
  __device__ int64_t operator()(int tile) const { return ranges[tile + 1] - ranges[tile]; }
};
struct ProcessedLength {
  const int32_t* processed;
  __device__ int64_t operator()(int tile) const { return processed[tile]; }
};

// A batch of splats in shared memory, local to the tile.
template <int kCount>
struct Batch {
  float4 shape[kCount];  // y, l11, l12, l22
  float4 rest[kCount];   // u, log2 opacity, x, inverse depth
  float4 color[kCount];  // r, g, b

  __device__ void put(int k, const float* splats, int32_t index, float left, float top) {
    const float2* from = reinterpret_cast<const float2*>(splats + kSplatValues * int64_t(index));
    const float2 a = from[0], b = from[1], c = from[2], d = from[3], e = from[4];
    const Splat<float> splat = {a.x, a.y, b.x, b.y, c.x, c.y, d.x, d.y, e.x, e.y};
    const LocalSplat<float> s = localise(splat, left, top);
    shape[k] = make_float4(s.y, s.l11, s.l12, s.l22);
    rest[k] = make_float4(s.u, s.log2_opacity, splat.x - left, s.inverse_depth);
    color[k] = make_float4(s.r, s.g, s.b, 0);
  }

  __device__ LocalSplat<float> local(int k) const {
    const float4 a = shape[k], b = rest[k];
    return {a.x, a.y, a.z, a.w, b.x, b.y, 0, 0, 0, b.w};
  }

  // Can splat k reach the box of pixels, in the tile?
  __device__ bool reaches(int k, float x0, float x1, float y0, float y1) const {
    const float4 a = shape[k], b = rest[k];
    const Splat<float> splat = {b.z, a.x, a.y, a.z, a.w, b.y, 0, 0, 0, 0};
    return box_reached(make_tile_test(splat, TileRect{0, 0, 1, 1}, 0, 0), x0, x1, y0, y1);
  }
};

template <class L, int kCount>
__device__ unsigned reached_by_warp(const Batch<kCount>& batch, const L& at, int from, int count) {
  const int k = from + threadIdx.x % 32;
  const bool hit = k < count && batch.reaches(k, at.left, at.left + L::kWide - 1, at.top, at.top + L::kHigh - 1);
  return __ballot_sync(kWarp, hit);
}

// Splats whose exponents a warp works out at once, going front to back: with one pixel a lane it would mostly wait.
template <class L>
constexpr int kTogether = L::kRun == 1 ? 2 : 1;

// Front to back through the splats that reach the warp, of 32 from `from`: step(k, p, exponent) for each and each pixel
// of the lane.
template <class L, int kCount, class Step>
__device__ __forceinline__ void front_to_back(const Batch<kCount>& batch, const L& at, int from, int count,
                                              const Step& step) {
  for (unsigned hits = reached_by_warp(batch, at, from, count); hits;) {
    int k[kTogether<L>];
    float t[kTogether<L>][L::kRun];
#pragma unroll
    for (int i = 0; i < kTogether<L>; ++i) {
      const bool exists = i == 0 || hits;
      k[i] = exists ? from + __ffs(hits) - 1 : k[0];
      hits &= hits - 1;
      const RowTerms<float> row = row_terms(batch.local(k[i]), float(at.y));
#pragma unroll
      for (int p = 0; p < L::kRun; ++p)
        t[i][p] = exists ? row_exponent(row, row_u(row, float(at.x + at.column(p)))) : -INFINITY;
    }
#pragma unroll
    for (int i = 0; i < kTogether<L>; ++i)
#pragma unroll
      for (int p = 0; p < L::kRun; ++p) step(k[i], p, t[i][p]);
  }
}

// Blocks a processor, which keep it to 56 (48 with one pixel a lane) registers, without spills on sm_90.
template <class L, bool kDepth, bool kLast>
__global__ void __launch_bounds__(L::kThreads, L::kRun == 1 ? 5 : 9)
    blend_kernel(BlendInput<float> in, const int32_t* order, Blended<float> out) {
  constexpr int kBatch = L::kThreads, kRun = L::kRun;
  __shared__ Batch<kBatch> batch;
  const L at;
  const int across = tile_count(in.image.width), tile = order[blockIdx.x];
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
    if (mine < count) batch.put(mine, in.splats, in.instances[first + mine], float(left), float(top));
    __syncthreads();
    for (int from = 0; open && from < count; from += 32) {
      front_to_back(batch, at, from, count, [&](int k, int p, float t) {
        const bool reached = t >= threshold[p];
        if (kTogether<L> == 1 && !reached) return;  // where splats are taken together, no branch keeps them apart
        const float alpha = capped<float, float>(exp2_device(t));
        const float after = transmittance[p] - alpha * transmittance[p];
        const bool ends = reached && after < float(kMinTransmittance), blended = reached && !ends;
        const float weight = blended ? alpha * transmittance[p] : 0;
        const float4 c = batch.color[k];
        red[p] += weight * c.x, green[p] += weight * c.y, blue[p] += weight * c.z;
        if (kDepth) depth[p] += weight * batch.rest[k].w;
        if (kLast && blended) last[p] = int(first - begin) + k + 1;
        if (blended) transmittance[p] = after;
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

struct CountBits {
  const uint32_t* bits;
  int64_t words;
  __host__ __device__ int32_t operator()(int64_t word) const {
#ifdef __CUDA_ARCH__
    return word < words ? __popc(bits[word]) : 0;
#else
    return 0;
#endif
  }
};

// How far each tile's backward has to go, and the slots of the instances up to there.
__global__ void __launch_bounds__(kTile* kTile)
    mark_kernel(BlendInput<float> in, const int32_t* last, SplatSlots slots, int32_t* processed, uint32_t* bits) {
  __shared__ int32_t most;
  if (threadIdx.x == 0) most = 0;
  __syncthreads();
  const int across = tile_count(in.image.width), tile = blockIdx.x;
  const int x = tile % across * kTile + threadIdx.x % kTile, y = tile / across * kTile + threadIdx.x / kTile;
  const int mine = x < in.image.width && y < in.image.height ? last[int64_t(y) * in.image.width + x] : 0;
  const int warp_most = __reduce_max_sync(kWarp, mine);
  if (threadIdx.x % 32 == 0) atomicMax(&most, warp_most);
  __syncthreads();
  if (threadIdx.x == 0) processed[tile] = most;
  for (int k = threadIdx.x; k < most; k += kTile * kTile) {
    const int64_t slot = slots.slot(in.instances[in.ranges[tile] + k], tile % across, tile / across);
    atomicOr(bits + (slot >> 5), 1u << (slot & 31));
  }
}

// Ten values summed over a warp in 12 shuffles: each step halves the values a lane keeps while doubling the lanes that
// are summed. `value` is the one whose sum this lane ends with, or -1.
__device__ __forceinline__ float transposed_sum(const float (&v)[kGradientValues], int& value) {
  const int lane = threadIdx.x % 32;
  const bool b16 = lane & 16, b8 = lane & 8, b4 = lane & 4, b2 = lane & 2;
  float a[5], b[3], c[2];
#pragma unroll
  for (int i = 0; i < 5; ++i) a[i] = (b16 ? v[i + 5] : v[i]) + __shfl_xor_sync(kWarp, b16 ? v[i] : v[i + 5], 16);
#pragma unroll
  for (int i = 0; i < 3; ++i) {
    const float high = i < 2 ? a[i + 3] : 0;
    b[i] = (b8 ? high : a[i]) + __shfl_xor_sync(kWarp, b8 ? a[i] : high, 8);
  }
#pragma unroll
  for (int i = 0; i < 2; ++i) {
    const float high = i < 1 ? b[2] : 0;
    c[i] = (b4 ? high : b[i]) + __shfl_xor_sync(kWarp, b4 ? b[i] : high, 4);
  }
  float sum = (b2 ? c[1] : c[0]) + __shfl_xor_sync(kWarp, b2 ? c[0] : c[1], 2);
  sum += __shfl_xor_sync(kWarp, sum, 1);
  const int within3 = b4 ? 2 : b2, within5 = (b8 ? 3 : 0) + within3;
  const bool exists = !(lane & 1) && !(b4 && b2) && within5 < 5;
  value = exists ? (b16 ? 5 : 0) + within5 : -1;
  return sum;
}

template <bool kDepth>
__global__ void __launch_bounds__(Backward::kThreads)
    blend_vjp_kernel(BlendInput<float> in, BlendGradient<float> g, const int32_t* processed, const int32_t* order,
                     Compact compact) {
  constexpr int kBatch = 64, kRun = Backward::kRun;
  __shared__ Batch<kBatch> batch;
  __shared__ float sums[Backward::kWarps * kBatch * kGradientValues];
  __shared__ int64_t row_of[kBatch];
  const Backward at;
  const int across = tile_count(in.image.width), tile = order[blockIdx.x], warp = threadIdx.x / 32;
  const int left = tile % across * kTile, top = tile / across * kTile;
  const int64_t plane = int64_t(in.image.width) * in.image.height;
  float transmittance[kRun], behind[kRun], red[kRun], green[kRun], blue[kRun], depth[kRun];
  int last[kRun], furthest = 0;
  for (int p = 0; p < kRun; ++p) {
    const int x = left + at.x + at.column(p), y = top + at.y;
    const bool inside = x < in.image.width && y < in.image.height;
    const int64_t pixel = inside ? int64_t(y) * in.image.width + x : 0;
    transmittance[p] = inside ? g.transmittance[pixel] : 1;
    last[p] = inside ? g.last[pixel] : 0;
    red[p] = inside ? g.color[pixel] : 0;
    green[p] = inside ? g.color[plane + pixel] : 0;
    blue[p] = inside ? g.color[2 * plane + pixel] : 0;
    depth[p] = kDepth && inside ? g.inverse_depth[pixel] : 0;
    behind[p] = in.background[0] * red[p] + in.background[1] * green[p] + in.background[2] * blue[p];
    if (g.transmittance_gradient && inside) behind[p] += g.transmittance_gradient[pixel];
    furthest = last[p] > furthest ? last[p] : furthest;
  }
  furthest = __reduce_max_sync(kWarp, furthest);
  const int64_t begin = in.ranges[tile];
  const SplatSlots slots{g.rects, g.slot_offsets};
  for (int end = processed[tile]; end > 0; end -= kBatch) {
    const int count = end < kBatch ? end : kBatch, first = end - count;
    __syncthreads();
    for (int k = threadIdx.x; k < count; k += Backward::kThreads) {
      const int32_t splat = in.instances[begin + first + k];
      batch.put(k, in.splats, splat, float(left), float(top));
      row_of[k] = compact.row(slots.slot(splat, tile % across, tile / across));
    }
    for (int k = threadIdx.x; k < Backward::kWarps * kBatch * kGradientValues; k += Backward::kThreads) sums[k] = 0;
    __syncthreads();
    for (int from = (count - 1) / 32 * 32; from >= 0; from -= 32) {
      if (first + from >= furthest) continue;
      unsigned hits = reached_by_warp(batch, at, from, count);
      while (hits) {
        const int bit = 31 - __clz(hits), k = from + bit;
        hits &= ~(1u << bit);
        const LocalSplat<float> splat = batch.local(k);
        const float4 c = batch.color[k];
        const RowTerms<float> row = row_terms(splat, float(at.y));
        float q0 = 0, qu = 0, quu = 0, r = 0, gr = 0, b = 0, d = 0;
        bool any = false;
#pragma unroll
        for (int p = 0; p < kRun; ++p) {
          const float u = row_u(row, float(at.x + at.column(p))), t = row_exponent(row, u);
          if (!(t >= kLeast) || first + k >= last[p]) continue;
          any = true;
          const float uncapped = exp2_device(t), alpha = capped<float, float>(uncapped);
          float value = c.x * red[p] + c.y * green[p] + c.z * blue[p];
          if (kDepth) value += splat.inverse_depth * depth[p];
          const float q = uncapped * alpha_gradient<float, float>(alpha, value, transmittance[p], behind[p]);
          const float weight = alpha * transmittance[p], qu_here = q * u;
          q0 += q, qu += qu_here, quu += qu_here * u;
          r += weight * red[p], gr += weight * green[p], b += weight * blue[p];
          if (kDepth) d += weight * depth[p];
        }
        if (!__any_sync(kWarp, any)) continue;
        // Along a row v is constant, so three of the moments come last.
        const float v[kGradientValues] = {q0, qu, row.v * q0, quu, row.v * qu, row.v * row.v * q0, r, gr, b, d};
        int value;
        const float sum = transposed_sum(v, value);
        if (value >= 0) sums[(warp * kBatch + k) * kGradientValues + value] = sum;
      }
    }
    __syncthreads();
    for (int k = threadIdx.x; k < count * kGradientValues; k += Backward::kThreads) {
      float sum = 0;
      for (int w = 0; w < Backward::kWarps; ++w) sum += sums[w * kBatch * kGradientValues + k];
      compact.rows[kGradientValues * row_of[k / kGradientValues] + k % kGradientValues] = sum;
    }
  }
}

__global__ void __launch_bounds__(256) moments_kernel(int64_t count, SlotSums sums, float* moments) {
  const int64_t i = int64_t(blockIdx.x) * 256 + threadIdx.x;
  __shared__ __align__(8) float stage[256 / 32 * SlotSums::kStage];
  float values[kGradientValues];
  sums.read(i, i < count && sums.seen(i), values, stage + threadIdx.x / 32 * SlotSums::kStage);
  if (i >= count) return;
  for (int v = 0; v < kGradientValues; ++v) moments[kGradientValues * i + v] = values[v];
}

template <class L>
void blend_as(const Queue& queue, const BlendInput<float>& in, const Blended<float>& out) {
  const auto kernel = out.inverse_depth ? (out.last ? blend_kernel<L, true, true> : blend_kernel<L, true, false>)
                                        : (out.last ? blend_kernel<L, false, true> : blend_kernel<L, false, false>);
  const int64_t tiles = tiles_of(in.image);
  const int32_t* order = heaviest_first(queue, tiles, ListLength{in.ranges});
  kernel<<<unsigned(tiles), L::kThreads, 0, stream_of(queue)>>>(in, order, out);
  check_launch("blend");
}

}  // namespace

template <>
void blend<float>(const Queue& queue, const BlendInput<float>& in, const Blended<float>& out) {
  (tiles_of(in.image) <= kFewTiles ? blend_as<Layout<1>> : blend_as<Layout<2>>)(queue, in, out);
}

Compact blend_rows(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g) {
  const cudaStream_t stream = stream_of(queue);
  const unsigned tiles = unsigned(tiles_of(in.image));
  const int64_t words = (g.slot_count + 31) / 32;
  uint32_t* bits = queue.array<uint32_t>(words + 1);
  int32_t *before = queue.array<int32_t>(words + 1), *processed = queue.array<int32_t>(tiles);
  GS_CUDA_CHECK(cudaMemsetAsync(bits, 0, (words + 1) * sizeof *bits, stream));
  mark_kernel<<<tiles, kTile * kTile, 0, stream>>>(in, g.last, SplatSlots{g.rects, g.slot_offsets}, processed, bits);
  check_launch("mark");
  const auto counts = thrust::make_transform_iterator(thrust::counting_iterator<int64_t>(0), CountBits{bits, words});
  size_t bytes = 0;
  GS_CUDA_CHECK(cub::DeviceScan::ExclusiveSum(nullptr, bytes, counts, before, words + 1, stream));
  void* memory = queue.allocate(queue.context, bytes);
  GS_CUDA_CHECK(cub::DeviceScan::ExclusiveSum(memory, bytes, counts, before, words + 1, stream));
  int64_t rows = g.instance_count;  // at most: one for each
  if (rows > kRowsUnasked) {
    int32_t processed_count = 0;
    GS_CUDA_CHECK(
        cudaMemcpyAsync(&processed_count, before + words, sizeof processed_count, cudaMemcpyDeviceToHost, stream));
    GS_CUDA_CHECK(cudaStreamSynchronize(stream));
    rows = processed_count;
  }
  const Compact compact{bits, before, queue.array<float>(size_t(rows) * kGradientValues)};
  const auto kernel = g.inverse_depth ? blend_vjp_kernel<true> : blend_vjp_kernel<false>;
  const int32_t* order = heaviest_first(queue, tiles, ProcessedLength{processed});
  kernel<<<tiles, Backward::kThreads, 0, stream>>>(in, g, processed, order, compact);
  check_launch("blend_vjp");
  return compact;
}

template <>
void blend_vjp<float>(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g) {
  if (!g.count) return;
  const SlotSums sums{blend_rows(queue, in, g), g.slot_offsets};
  moments_kernel<<<unsigned((g.count + 255) / 256), 256, 0, stream_of(queue)>>>(g.count, sums, g.moments);
  check_launch("moments");
}

}  // namespace cuda
}  // namespace gs
