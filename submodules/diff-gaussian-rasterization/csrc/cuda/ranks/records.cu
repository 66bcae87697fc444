// Which Gaussians each band of an image gets, as records: counted, then listed.
#include <cuda_runtime.h>

#include <cub/cub.cuh>

#include "backend.h"
#include "cuda/queue/queue.cuh"
#include "math/splat.h"

namespace gs {
namespace cuda {

using baseline::splat_row;

namespace {

constexpr int kThreads = kRecordBlock, kWarps = kThreads / 32;
constexpr int kBands = 32;  // at a time

// Which of a block's Gaussians reach each band of a part of the bands: a bit for each, a word for each warp.
struct Reached {
  uint32_t words[kBands][kWarps];

  // All threads call this. Returns how many bands the part has.
  __device__ int find(const RecordInput& in, int64_t i, int first) {
    const int count = min(kBands, in.bands - first);
    const bool seen = i < in.count && in.tile_counts[i] > 0;
    const int top = seen ? in.rects[4 * i + 1] : 0, bottom = seen ? in.rects[4 * i + 3] : 0;
    __syncthreads();  // the part before has been read
    for (int band = 0; band < count; ++band) {
      const int begin = in.limits[first + band], end = in.limits[in.bands + first + band];
      const unsigned word = __ballot_sync(kWarp, seen && top < end && bottom > begin);
      if ((threadIdx.x & 31) == 0) words[band][threadIdx.x / 32] = word;
    }
    __syncthreads();
    return count;
  }
  __device__ bool has(int band) const { return words[band][threadIdx.x / 32] >> (threadIdx.x & 31) & 1; }
  __device__ int before(int band) const {
    int sum = __popc(words[band][threadIdx.x / 32] & ((1u << (threadIdx.x & 31)) - 1));
    for (int warp = 0; warp < int(threadIdx.x / 32); ++warp) sum += __popc(words[band][warp]);
    return sum;
  }
  __device__ int total(int band) const {
    int sum = 0;
    for (const uint32_t word : words[band]) sum += __popc(word);
    return sum;
  }
};

__global__ void __launch_bounds__(kThreads) count_kernel(RecordInput in, int64_t blocks, int32_t* counts) {
  __shared__ Reached reached;
  __shared__ int32_t all;
  if (threadIdx.x == 0) all = 0;
  for (int first = 0; first < in.bands; first += kBands) {
    const int count = reached.find(in, int64_t(blockIdx.x) * kThreads + threadIdx.x, first);
    if (int(threadIdx.x) < count) {
      const int32_t total = reached.total(threadIdx.x);
      counts[(first + threadIdx.x) * blocks + blockIdx.x] = total;
      atomicAdd(&all, total);
    }
  }
  __syncthreads();
  if (threadIdx.x == 0) counts[in.bands * blocks + blockIdx.x] = all;
}

// What a record has of a splat; nothing if there is none.
template <int kPairs>
struct Row {
  float2 splat[kPairs] = {};
  float depth = 0;
  int4 rect = {};
  int32_t tile_count = 0;

  __device__ void read(const RecordInput& in, const RecordLists<float>& from, int64_t i) {
    for (int k = 0; k < kPairs; ++k) splat[k] = reinterpret_cast<const float2*>(from.splats)[kPairs * i + k];
    depth = from.depths[i], rect = reinterpret_cast<const int4*>(in.rects)[i], tile_count = in.tile_counts[i];
  }
  __device__ void write(const RecordLists<float>& to, int64_t at, int32_t place, int64_t i) const {
    if (uint64_t(at) >= uint64_t(to.room)) return;
    to.gaussians[at] = i, to.places[at] = place;
    for (int k = 0; k < kPairs; ++k) reinterpret_cast<float2*>(to.new_splats)[kPairs * at + k] = splat[k];
    to.new_depths[at] = depth, reinterpret_cast<int4*>(to.rects)[at] = rect, to.tile_counts[at] = tile_count;
  }
};

// begins: where the records of each band and block begin; and those of each block, in the order of Gaussians. The last
// block has no Gaussians.
template <int kPairs>
__global__ void __launch_bounds__(kThreads)
    list_kernel(RecordInput in, int64_t blocks, const int32_t* begins, RecordLists<float> to) {
  __shared__ Reached reached;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  Row<kPairs> row;
  int32_t place = begins[in.bands * blocks + blockIdx.x];
  if (blockIdx.x == blocks - 1) {
    if (threadIdx.x == 0)
      for (int64_t last = blocks - 1; last < in.bands * blocks; last += blocks)
        for (int32_t k = 0; k < to.counts[last]; ++k) row.write(to, int64_t(begins[last]) + k, place++, in.count);
    return;
  }
  for (int first = 0; first < in.bands; first += kBands) {
    const int count = reached.find(in, i, first);
    for (int band = 0; band < count; ++band) place += reached.before(band);
  }
  if (i < in.count && in.tile_counts[i] > 0) row.read(in, to, i);
  for (int first = 0; first < in.bands; first += kBands) {
    const int count = reached.find(in, i, first);
    for (int band = 0; band < count; ++band) {
      if (!reached.has(band)) continue;
      row.write(to, int64_t(begins[(first + band) * blocks + blockIdx.x]) + reached.before(band), place++, i);
    }
  }
}

}  // namespace

void count_records(const Queue& queue, const RecordInput& in, int32_t* counts) {
  const unsigned blocks = blocks_for(in.count, kThreads);
  if (!blocks) return;
  count_kernel<<<blocks, kThreads, 0, stream_of(queue)>>>(in, blocks, counts);
  check_launch("count_records");
}

void list_records(const Queue& queue, const RecordInput& in, const RecordLists<float>& to) {
  const cudaStream_t stream = stream_of(queue);
  const unsigned blocks = blocks_for(in.count, kThreads) + 1;
  const int64_t by_band = int64_t(in.bands) * blocks;
  int32_t* begins = queue.array<int32_t>(by_band + blocks);
  const auto scan = [&](int64_t first, int64_t count) {
    with_memory(queue, [&](void* memory, size_t& bytes) {
      return cub::DeviceScan::ExclusiveSum(memory, bytes, to.counts + first, begins + first, count, stream);
    });
  };
  scan(0, by_band), scan(by_band, blocks);
  const auto list =
      to.row == splat_row(kNoRays) ? list_kernel<splat_row(kNoRays) / 2> : list_kernel<splat_row(kPinholeRays) / 2>;
  list<<<blocks, kThreads, 0, stream>>>(in, blocks, begins, to);
  check_launch("list_records");
}

}  // namespace cuda
}  // namespace gs
