// Which Gaussians each band of an image gets, as records: counted, then listed.
#include <cuda_runtime.h>

#include <cub/cub.cuh>

#include "../backend.h"
#include "queue.cuh"

namespace gs {
namespace cuda {

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

// begins: where the records of each band and block begin; and those of each block, in the order of Gaussians.
__global__ void __launch_bounds__(kThreads)
    list_kernel(RecordInput in, int64_t blocks, const int32_t* begins, RecordLists to) {
  __shared__ Reached reached;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  int32_t place = begins[in.bands * blocks + blockIdx.x];
  for (int first = 0; first < in.bands; first += kBands) {
    const int count = reached.find(in, i, first);
    for (int band = 0; band < count; ++band) place += reached.before(band);
  }
  for (int first = 0; first < in.bands; first += kBands) {
    const int count = reached.find(in, i, first);
    for (int band = 0; band < count; ++band) {
      if (!reached.has(band)) continue;
      const int64_t at = int64_t(begins[(first + band) * blocks + blockIdx.x]) + reached.before(band);
      if (uint64_t(at) < uint64_t(to.room)) to.gaussians[at] = i, to.places[at] = place;
      ++place;
    }
  }
}

}  // namespace

void list_records(const Queue& queue, const RecordInput& in, const RecordLists& to) {
  const cudaStream_t stream = stream_of(queue);
  const unsigned blocks = blocks_for(in.count, kThreads);
  if (!blocks) return;
  count_kernel<<<blocks, kThreads, 0, stream>>>(in, blocks, to.counts);
  check_launch("count_records");
  const int64_t by_band = int64_t(in.bands) * blocks;
  int32_t* begins = queue.array<int32_t>(by_band + blocks);
  const auto scan = [&](int64_t first, int64_t count) {
    with_memory(queue, [&](void* memory, size_t& bytes) {
      return cub::DeviceScan::ExclusiveSum(memory, bytes, to.counts + first, begins + first, count, stream);
    });
  };
  scan(0, by_band), scan(by_band, blocks);
  list_kernel<<<blocks, kThreads, 0, stream>>>(in, blocks, begins, to);
  check_launch("list_records");
}

}  // namespace cuda
}  // namespace gs
