// Packs splats for other processes, and brings rows that come from these into the order of one.
#include <cuda_runtime.h>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/cub.cuh>

#include "../backend.h"
#include "../math/absolute.h"
#include "../math/splat.h"
#include "queue.cuh"

namespace gs {
namespace cuda {

using baseline::kAbsoluteValues, baseline::kGradientValues, baseline::kSplatValues;

namespace {

constexpr int kThreads = 256;

// Four threads move a row of sixteen words: two of the splat's first eight values, one of its last two with depth and
// number of tiles, one of the rectangle. They read and write pairs, as that is how rows of ten values are aligned.
constexpr int kQuads = 4;
static_assert(packed_words(1) == 4 * kQuads && kSplatValues == 10);
constexpr int kMixed = 2, kRect = 3;

template <class Pair, class Word>
__device__ __forceinline__ Pair* pairs_of(Word* splats, Word* rects, int64_t splat, int quad) {
  return reinterpret_cast<Pair*>(quad == kRect ? rects + 4 * splat : splats + kSplatValues * splat + 4 * quad);
}

__global__ void __launch_bounds__(kThreads) pack_kernel(PackInput in) {
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k >= kQuads * in.count) return;
  const int64_t splat = in.gaussians[k / kQuads];
  const int quad = k % kQuads;
  const int2* from = pairs_of<const int2>(in.splats, in.rects, splat, quad);
  const int2 low = from[0];
  const int2 high = quad == kMixed ? make_int2(in.depths[splat], in.tile_counts[splat]) : from[1];
  reinterpret_cast<int4*>(in.packed)[k] = make_int4(low.x, low.y, high.x, high.y);
}

__global__ void __launch_bounds__(kThreads) unpack_kernel(UnpackInput in) {
  const int64_t k = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (k >= kQuads * in.count) return;
  const int64_t splat = k / kQuads;
  const int quad = k % kQuads;
  const int4 words = reinterpret_cast<const int4*>(in.packed)[k];
  int2* to = pairs_of<int2>(in.splats, in.rects, splat, quad);
  to[0] = make_int2(words.x, words.y);
  if (quad == kMixed)
    in.depths[splat] = words.z, in.tile_counts[splat] = words.w;
  else
    to[1] = make_int2(words.z, words.w);
}

__global__ void __launch_bounds__(kThreads) order_counts_kernel(MoveInput in, int32_t* ordered) {
  const int64_t run = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (run < in.runs && uint32_t(in.places[run]) < in.runs) ordered[in.places[run]] = in.counts[run];
}

constexpr int kWindow = 32;        // rows of a warp
constexpr int32_t kUnmarked = -1;  // the byte that marks are set to

// Marks the row where a run begins, and the first row in each window that the run reaches, by the row to move to. So a
// warp finds the marks that its rows need in its own window, whatever empty or long runs there are.
struct MarkAt {
  MoveInput in;
  const int32_t* begins;  // by place
  int32_t* marks;         // (rows)
  int64_t run;
  __host__ __device__ void operator=(int32_t first) const {
#ifdef __CUDA_ARCH__
    if (in.counts[run] <= 0 || first < 0 || uint32_t(in.places[run]) >= in.runs) return;
    const int64_t end = min(int64_t(first) + in.counts[run], in.rows);
    const int32_t shift = begins[in.places[run]] - first;
    for (int64_t row = first; row < end; row = (row / kWindow + 1) * kWindow) marks[row] = int32_t(row) + shift;
#endif
  }
};

struct Marks {
  MoveInput in;
  const int32_t* begins;
  int32_t* marks;
  __host__ __device__ MarkAt operator()(int64_t run) const { return {in, begins, marks, run}; }
};

// A warp moves a window of rows, whose runs it reads side by side.
template <int kPairs>
__global__ void __launch_bounds__(kThreads) move_kernel(MoveInput in, const int32_t* marks) {
  const int lane = threadIdx.x & 31;
  const int64_t first = int64_t(blockIdx.x) * kThreads + threadIdx.x - lane;
  if (first >= in.rows) return;
  const int32_t mark = first + lane < in.rows ? marks[first + lane] : kUnmarked;
  const unsigned before = __ballot_sync(kWarp, mark != kUnmarked) & (0xffffffffu >> (31 - lane));
  const int marked = 31 - __clz(before);
  const int32_t begin = __shfl_sync(kWarp, mark, marked & 31);
  const int32_t place = before ? begin + lane - marked : kUnmarked;
  const int64_t left = kPairs * (in.rows - first);
  const int2* from = reinterpret_cast<const int2*>(in.from) + kPairs * first;
  int2 pairs[kPairs];
#pragma unroll
  for (int k = 0; k < kPairs; ++k)
    if (32 * k + lane < left) pairs[k] = from[32 * k + lane];
#pragma unroll
  for (int k = 0; k < kPairs; ++k) {
    const int pair = 32 * k + lane, row = pair / kPairs;
    const int64_t to = __shfl_sync(kWarp, place, row);
    if (pair < left && uint64_t(to) < uint64_t(in.rows))
      reinterpret_cast<int2*>(in.to)[kPairs * to + pair - kPairs * row] = pairs[k];
  }
}

}  // namespace

void pack_splats(const Queue& queue, const PackInput& in) {
  if (!in.count) return;
  pack_kernel<<<blocks_for(kQuads * in.count, kThreads), kThreads, 0, stream_of(queue)>>>(in);
  check_launch("pack_splats");
}

void unpack_splats(const Queue& queue, const UnpackInput& in) {
  if (!in.count) return;
  unpack_kernel<<<blocks_for(kQuads * in.count, kThreads), kThreads, 0, stream_of(queue)>>>(in);
  check_launch("unpack_splats");
}

void move_runs(const Queue& queue, const MoveInput& in) {
  if (!in.rows || !in.runs) return;
  const cudaStream_t stream = stream_of(queue);
  int32_t *begins = queue.array<int32_t>(in.runs), *marks = queue.array<int32_t>(in.rows);
  order_counts_kernel<<<blocks_for(in.runs, kThreads), kThreads, 0, stream>>>(in, begins);
  check_launch("order_counts");
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, begins, begins, in.runs, stream);
  });
  GS_CUDA_CHECK(cudaMemsetAsync(marks, kUnmarked, in.rows * sizeof *marks, stream));
  const auto at = thrust::make_transform_iterator(thrust::counting_iterator<int64_t>(0), Marks{in, begins, marks});
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, in.counts, at, in.runs, stream);
  });
  const auto move = in.words == kGradientValues ? move_kernel<kGradientValues / 2>
                                                : move_kernel<(kGradientValues + kAbsoluteValues) / 2>;
  move<<<blocks_for(in.rows, kThreads), kThreads, 0, stream>>>(in, marks);
  check_launch("move_runs");
}

}  // namespace cuda
}  // namespace gs
