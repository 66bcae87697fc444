// Gradient rows by splat: summed, taken from a backward, and put where SlotSums finds them.
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/cub.cuh>

#include "backend.h"
#include "gradient_rows.cuh"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads)
    absolute_kernel(const int32_t* halted, int64_t count, SlotSumsOf<kAbsoluteValues> sums, const float* splats,
                    int row, Image image, float* absolute) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  constexpr int kStage = SlotSumsOf<kAbsoluteValues>::kStage;
  __shared__ __align__(8) float stage[kThreads / 32 * kStage];
  float of_pixels[kAbsoluteValues];
  const bool seen = i < count && sums.seen(i);
  sums.read(i, seen, of_pixels, stage + threadIdx.x / 32 * kStage);
  if (i >= count) return;
  absolute[i] = seen ? absolute_length(splats[row * i + 2], of_pixels[0], of_pixels[1], image) : 0;
}

template <int kRays>
__global__ void __launch_bounds__(kThreads) moments_kernel(const int32_t* halted, int64_t count, SlotSums<kRays> sums,
                                                           float* moments, int channels, float* of_channels) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  constexpr int kRow = kGradientRow<kRays>, kStage = SlotSums<kRays>::kStage;
  __shared__ __align__(8) float stage[kThreads / 32 * kStage];
  float values[kRow];
  sums.read(i, i < count && sums.seen(i), values, stage + threadIdx.x / 32 * kStage);
  if (i >= count) return;
  for (int v = 0; v < kRow; ++v) moments[kRow * i + v] = values[v];
  for (int c = 0; c < channels; ++c) of_channels[channels * i + c] = values[kColorMoment + c];
}

__global__ void __launch_bounds__(kThreads)
    count_rows_kernel(const int32_t* halted, int64_t count, RowPlaces rows, const SplatSlots* slots, int32_t* counts) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < count) counts[i] = int32_t(rows.row(slots[i + 1].first) - rows.row(slots[i].first));
}

// Rows with the values of absolute gradients, in pairs, and the two arrays of their two parts.
template <class Pair, int kRays>
struct Halves {
  static constexpr int kGradientPairs = kGradientRow<kRays> / 2, kPairs = kGradientPairs + kAbsoluteValues / 2;
  Pair *gradients, *absolute;
  __device__ Pair& operator[](int64_t pair) const {
    const int64_t row = pair / kPairs;
    const int of_row = int(pair - row * kPairs);
    return of_row < kGradientPairs ? gradients[kGradientPairs * row + of_row] : absolute[row];
  }
};

template <class From, class To>
__global__ void __launch_bounds__(kThreads) copy_pairs_kernel(const int32_t* halted, int64_t pairs, From from, To to) {
  if (!begin_work(halted)) return;
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k < pairs) to[k] = from[k];
}

template <class From, class To>
void copy_pairs(const Queue& queue, int64_t pairs, From from, To to) {
  if (!pairs) return;
  launch(queue, "copy_pairs", copy_pairs_kernel<From, To>, blocks_for(pairs, kThreads), kThreads, pairs, from, to);
}

template <int kRays>
Halves<float2, kRays> halves(float* gradients, float* absolute) {
  return {reinterpret_cast<float2*>(gradients), reinterpret_cast<float2*>(absolute)};
}

// What lies before a splat: splats that were seen, in the upper 32 bits, and rows, in the lower ones.
struct SeenAndRows {
  SplatRows<float> in;
  __host__ __device__ int64_t operator()(int64_t splat) const {
#ifdef __CUDA_ARCH__
    if (splat < in.count && in.tile_counts[splat]) return (int64_t(1) << 32) + in.counts[splat];
#endif
    return 0;
  }
};

// A splat that was seen has 32 slots, the bits of one word, and before that word lie the rows before the splat. So no
// bit is looked at, and SlotSums finds each splat's rows, and whether it was seen.
struct WordAt {
  SplatRows<float> in;
  SplatSlots* slots;
  int32_t* before;
  int64_t splat;
  __host__ __device__ void operator=(int64_t sums) const {
    const int64_t word = sums >> 32;
    slots[splat] = {32 * word, 0, 0};
    if (splat == in.count || in.tile_counts[splat]) before[word] = int32_t(sums);
  }
};

struct Words {
  SplatRows<float> in;
  SplatSlots* slots;
  int32_t* before;
  __host__ __device__ WordAt operator()(int64_t splat) const { return {in, slots, before, splat}; }
};

// Finds where the gradient rows of each splat begin, by a sum over the counts of the splats before it.
void lay_out(const Queue& queue, const SplatRows<float>& in, SplatSlots* slots, int32_t* before) {
  const thrust::counting_iterator<int64_t> splats(0);
  const auto counts = thrust::make_transform_iterator(splats, SeenAndRows{in});
  const auto words = thrust::make_transform_iterator(splats, Words{in, slots, before});
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, words, in.count + 1, stream_of(queue));
  });
}

template <int kRays>
void sum_moments(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g) {
  const SlotSums<kRays> sums{fill_rows<kRays>(queue, in, g), g.slots};
  const bool held = g.values && !g.values_apart(in.channels);
  launch(queue, "moments", moments_kernel<kRays>, blocks_for(g.count, kThreads), kThreads, g.count, sums, g.moments,
         held ? int(in.channels.count) : 0, g.values);
}

}  // namespace

void find_lengths(const Queue& queue, int64_t count, const SlotSumsOf<kAbsoluteValues>& sums, const float* splats,
                  int rays, Image image, float* absolute) {
  launch(queue, "absolute", absolute_kernel, blocks_for(count, kThreads), kThreads, count, sums, splats,
         splat_row(rays), image, absolute);
}

void count_rows(const Queue& queue, int64_t count, const RowPlaces& rows, const SplatSlots* slots, int32_t* counts) {
  launch(queue, "count_rows", count_rows_kernel, blocks_for(count, kThreads), kThreads, count, rows, slots, counts);
}

// Writes rows of gradients and of absolute gradients, which are filled apart, as one row each.
template <int kRays>
void join_rows(const Queue& queue, int64_t rows, const FilledRows<kRays>& from, float* to) {
  const auto both = halves<kRays>(from.gradients.values, from.absolute.values);
  copy_pairs(queue, both.kPairs * rows, both, reinterpret_cast<float2*>(to));
}
template void join_rows<kNoRays>(const Queue&, int64_t, const FilledRows<kNoRays>&, float*);
template void join_rows<kPinholeRays>(const Queue&, int64_t, const FilledRows<kPinholeRays>&, float*);

template <int kRays>
SlotSums<kRays> sums_of(const Queue& queue, const SplatRows<float>& in, const RowSums<float>& to) {
  SplatSlots* slots = queue.array<SplatSlots>(in.count + 1);
  int32_t* before = queue.array<int32_t>(in.count + 1);
  lay_out(queue, in, slots, before);
  float* gradients = const_cast<float*>(in.rows);  // sums only read them
  if (to.absolute) {
    gradients = queue.array<float>(in.row_count * kGradientRow<kRays>);
    float* absolute = queue.array<float>(in.row_count * kAbsoluteValues);
    const auto both = halves<kRays>(gradients, absolute);
    copy_pairs(queue, both.kPairs * in.row_count, reinterpret_cast<const float2*>(in.rows), both);
    find_lengths(queue, in.count, {{{nullptr, before}, absolute}, slots}, to.splats, kRays, to.image, to.absolute);
    queue.release(queue.context, absolute);
  }
  return {{{nullptr, before}, gradients}, slots};
}
template SlotSums<kNoRays> sums_of<kNoRays>(const Queue&, const SplatRows<float>&, const RowSums<float>&);
template SlotSums<kPinholeRays> sums_of<kPinholeRays>(const Queue&, const SplatRows<float>&, const RowSums<float>&);

template <>
void blend_vjp<float>(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g) {
  if (g.count) by_rays(in.rays, [&](auto rays) { sum_moments<rays>(queue, in, g); });
}

}  // namespace cuda
}  // namespace gs
