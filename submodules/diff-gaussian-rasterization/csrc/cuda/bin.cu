// Two small sorts instead of one large one: splats by depth, then their instances, emitted in that order, stably by
// tile.
#include <cuda_runtime.h>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/cub.cuh>

#include "emit.cuh"
#include "gs/cuda_check.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

cudaStream_t stream_of(const Queue& queue) { return static_cast<cudaStream_t>(queue.stream); }
dim3 blocks_for(int64_t n) { return dim3(unsigned((n + kThreads - 1) / kThreads)); }

// CUB's functions want to be called twice: for the size of their memory, and with it.
template <class Run>
void with_memory(const Queue& queue, const Run& run) {
  size_t bytes = 0;
  GS_CUDA_CHECK(run(nullptr, bytes));
  void* memory = queue.allocate(queue.context, bytes);
  GS_CUDA_CHECK(run(memory, bytes));
}

struct Widen {
  __host__ __device__ int64_t operator()(int32_t count) const { return count; }
};

// The number of instances, on its way to the host.
class InstanceCount {
 public:
  InstanceCount(const Queue& queue, int64_t count, const int32_t* tile_counts) : host_(queue.pinned(queue.context)) {
    int64_t* total = queue.array<int64_t>(1);
    const auto counts = thrust::make_transform_iterator(tile_counts, Widen{});
    with_memory(queue, [&](void* memory, size_t& bytes) {
      return cub::DeviceReduce::Sum(memory, bytes, counts, total, count, stream_of(queue));
    });
    GS_CUDA_CHECK(cudaEventCreateWithFlags(&arrived_, cudaEventDisableTiming));
    GS_CUDA_CHECK(cudaMemcpyAsync(host_, total, sizeof *host_, cudaMemcpyDeviceToHost, stream_of(queue)));
    GS_CUDA_CHECK(cudaEventRecord(arrived_, stream_of(queue)));
  }
  InstanceCount(const InstanceCount&) = delete;
  // Waits, too: after an error in between the number must not come into memory that is another's by then.
  ~InstanceCount() { cudaEventSynchronize(arrived_), cudaEventDestroy(arrived_); }

  // Waits for it, and for nothing that was queued since.
  int64_t value() const {
    GS_CUDA_CHECK(cudaEventSynchronize(arrived_));
    return *host_;
  }

 private:
  int64_t* host_;
  cudaEvent_t arrived_;
};

// The number of tiles of the k-th splat in depth order.
struct OrderedCount {
  const int32_t* order;
  const int32_t* counts;
  __host__ __device__ int64_t operator()(int32_t k) const { return counts[order[k]]; }
};

__global__ void count_up_kernel(int64_t n, int32_t* values) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) values[i] = int32_t(i);
}

// Where each tile's list begins: every tile from that of the instance before to this one's starts here.
template <class Key>
__global__ void ranges_kernel(int64_t instances, int64_t tiles, const Key* sorted, int64_t* ranges) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i > instances) return;
  const int64_t from = i == 0 ? 0 : int64_t(sorted[i - 1]) + 1, to = i == instances ? tiles : int64_t(sorted[i]);
  for (int64_t tile = from; tile <= to; ++tile) ranges[tile] = i;
}

__global__ void gather_kernel(int64_t n, const int32_t* from, const int32_t* at, int32_t* to) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) to[i] = from[at[i]];
}

int bits_for(int64_t values) {
  int bits = 1;
  while ((int64_t(1) << bits) < values) ++bits;
  return bits;
}

// Splats by depth, ties by index (the sort is stable and starts from that order); culled ones, infinitely far, last.
const int32_t* sort_by_depth(const Queue& queue, int64_t n, const float* depths) {
  uint32_t* sorted_keys = queue.array<uint32_t>(n);
  int32_t *index = queue.array<int32_t>(n), *order = queue.array<int32_t>(n);
  count_up_kernel<<<blocks_for(n), kThreads, 0, stream_of(queue)>>>(n, index);
  // Positive floats sort like their bits.
  const uint32_t* keys = reinterpret_cast<const uint32_t*>(depths);
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, sorted_keys, index, order, n, 0, 32, stream_of(queue));
  });
  return order;
}

// order: splats by depth.
template <class Key>
void bin_with(const Queue& queue, int64_t n, const Projected<float>& in, const int32_t* order, Image image,
              int64_t instances, const Binned& out) {
  const int64_t tiles = int64_t(tile_count(image.width)) * tile_count(image.height);
  const cudaStream_t stream = stream_of(queue);
  Key *keys = queue.array<Key>(instances), *sorted_keys = queue.array<Key>(instances);
  if (instances) {
    int64_t* offsets = queue.array<int64_t>(n);
    const auto counts =
        thrust::make_transform_iterator(thrust::counting_iterator<int32_t>(0), OrderedCount{order, in.tile_counts});
    with_memory(queue, [&](void* memory, size_t& bytes) {
      return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, offsets, n, stream);
    });
    int32_t* owners = queue.array<int32_t>(instances);
    const unsigned blocks = unsigned((instances + kEmitted - 1) / kEmitted);
    emit_kernel<Key>
        <<<blocks, kEmitThreads, 0, stream>>>(n, instances, order, offsets, in, image, keys, owners, out.slot_offsets);
    check_launch("emit");
    const int end_bit = bits_for(tiles);
    if (out.slots) {
      int32_t* index = queue.array<int32_t>(instances);
      count_up_kernel<<<blocks_for(instances), kThreads, 0, stream>>>(instances, index);
      with_memory(queue, [&](void* memory, size_t& bytes) {
        return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, sorted_keys, index, out.slots, instances, 0,
                                               end_bit, stream);
      });
      gather_kernel<<<blocks_for(instances), kThreads, 0, stream>>>(instances, owners, out.slots, out.instances);
    } else {
      with_memory(queue, [&](void* memory, size_t& bytes) {
        return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, sorted_keys, owners, out.instances, instances, 0,
                                               end_bit, stream);
      });
    }
  }
  ranges_kernel<Key><<<blocks_for(instances + 1), kThreads, 0, stream>>>(instances, tiles, sorted_keys, out.ranges);
  check_launch("bin");
}

}  // namespace

template <>
void bin<float>(const Queue& queue, int64_t count, const Projected<float>& in, Image image, const BinMemory& memory) {
  int64_t instances = 0;
  const int32_t* order = nullptr;
  if (count) {
    const InstanceCount counted(queue, count, in.tile_counts);
    order = sort_by_depth(queue, count, in.depths);  // the GPU is busy while the host waits for the number
    instances = counted.value();
  }
  const Binned out = memory.take(memory.context, instances);
  const int64_t tiles = int64_t(tile_count(image.width)) * tile_count(image.height);
  const auto run = tiles <= 1 << 16 ? bin_with<uint16_t> : bin_with<uint32_t>;
  run(queue, count, in, order, image, instances, out);
}

}  // namespace cuda
}  // namespace gs
