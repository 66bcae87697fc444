// Finds the processed instances, marks their slots, and orders the chunks of their lists.
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/cub.cuh>
#include <optional>

#include "cuda/queue/ahead.cuh"
#include "cuda/queue/host_numbers.cuh"
#include "math/slots.h"
#include "math/tiles.h"
#include "processed.cuh"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

// Up to this many instances, each one gets a gradient row, 40 MiB at most. Then the host need not wait for the number
// of processed instances.
constexpr int64_t kRowsUnasked = 1 << 20;

struct ProcessedLength {
  const int32_t* processed;
  __device__ int64_t operator()(int tile) const { return processed[tile]; }
};

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

// Finds how far each tile's backward has to go, and marks the slots of the instances up to there.
__global__ void __launch_bounds__(kTile* kTile)
    mark_kernel(const int32_t* halted, BlendInput<float> in, const int32_t* last, const SplatSlots* slots,
                int32_t* processed, uint32_t* bits) {
  if (!begin_work(halted)) return;
  __shared__ int32_t most;
  if (threadIdx.x == 0) most = 0;
  __syncthreads();
  const int across = tile_count(in.image.width), tile = blockIdx.x;
  const int x = tile % across * kTile + threadIdx.x % kTile, y = tile / across * kTile + threadIdx.x / kTile;
  const int mine = x < in.image.width && y < in.image.height ? last[int64_t(y) * in.image.width + x] : 0;
  const int warp_most = warp_max(mine);
  if (threadIdx.x % 32 == 0) atomicMax(&most, warp_most);
  __syncthreads();
  if (threadIdx.x == 0) processed[tile] = most;
  constexpr int kThreads = kTile * kTile, kAhead = 4;  // slots that are found at once
  const int32_t* list = in.instances + in.ranges[tile];
  for (int k = threadIdx.x; k < most; k += kAhead * kThreads) {
    int64_t slot[kAhead];
#pragma unroll
    for (int j = 0; j < kAhead; ++j)
      if (k + j * kThreads < most) slot[j] = slot_of(slots, list[k + j * kThreads], tile % across, tile / across);
#pragma unroll
    for (int j = 0; j < kAhead; ++j)
      if (k + j * kThreads < most) atomicOr(bits + (slot[j] >> 5), 1u << (slot[j] & 31));
  }
}

__global__ void judge_rows_kernel(const int32_t* halted, Ahead ahead, const int32_t* rows) {
  begin_work(halted);  // a halted step is reported, too
  judge_rows(ahead, *rows);
}

}  // namespace

Processed find_processed(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g,
                         int32_t chunk_size, bool exact) {
  const cudaStream_t stream = stream_of(queue);
  const unsigned tiles = unsigned(tiles_of(in.image));
  const int64_t words = (g.slot_count + 31) / 32;
  uint32_t* bits = queue.array<uint32_t>(words + 1);
  int32_t *before = queue.array<int32_t>(words + 1), *processed = queue.array<int32_t>(tiles);
  GS_CUDA_CHECK(cudaMemsetAsync(bits, 0, (words + 1) * sizeof *bits, stream));
  launch(queue, "mark", mark_kernel, tiles, kTile * kTile, in, g.last, g.slots, processed, bits);
  const auto counts = thrust::make_transform_iterator(thrust::counting_iterator<int64_t>(0), CountBits{bits, words});
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, before, words + 1, stream);
  });
  int64_t rows = g.ahead ? g.ahead->room.rows : g.instance_count;  // an upper bound
  std::optional<HostNumbers<int32_t>> processed_count;
  if (g.ahead) {
    launch(queue, "judge_rows", judge_rows_kernel, 1, 1, *g.ahead, before + words);
  } else if (exact || rows > kRowsUnasked)
    processed_count.emplace(queue, before + words, 1);
  Schedule schedule = longest_first(queue, tiles, ProcessedLength{processed}, chunk_size, rows);
  if (processed_count) rows = *processed_count->wait(), schedule = schedule.shortened(rows);
  return {{bits, before}, processed, schedule, rows};
}

}  // namespace cuda
}  // namespace gs
