// Nearest neighbours by a tree like the CPU's (box_tree.h), built level by level: a sort by node and by the coordinate
// along the node's widest axis puts the halves of every node of the level into their places at once. A search for each
// point follows.
#include <thrust/iterator/counting_iterator.h>

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_select.cuh>
#include <stdexcept>

#include "backend.h"
#include "cuda/box_tree.h"
#include "gs/cuda_check.h"

namespace gs {
namespace {

constexpr int kThreads = 256;
constexpr int kSearchThreads = 128;

unsigned blocks(int64_t n, int threads) { return unsigned((n + threads - 1) / threads); }

__device__ int64_t global_thread() { return int64_t(blockIdx.x) * blockDim.x + threadIdx.x; }

template <class T>
struct IsFinite {
  const T* points;
  __device__ bool operator()(int32_t i) const {
    const T* x = points + 3 * int64_t(i);
    return isfinite(x[0]) && isfinite(x[1]) && isfinite(x[2]);
  }
};

__global__ void clear_extents(Extent* extents, int64_t count) {
  const int64_t i = global_thread();
  if (i < count) extents[i] = {{~0u, ~0u, ~0u}, {0, 0, 0}};
}

// Measures the extent of every node. Minima and maxima of integers do not depend on the order of the threads.
template <class T>
__global__ void measure(const T* points, const int32_t* order, int64_t n, int level, Extent* extents) {
  // Threads beyond the end repeat the last point, so that warps stay whole; that changes no minimum.
  const int64_t at = min(global_thread(), n - 1);
  const T* x = points + 3 * int64_t(order[at]);
  const int node = int(node_of(n, level, at));
  Extent e;
  for (int k = 0; k < 3; ++k) e.low[k] = e.high[k] = sortable(float(x[k]));
  const bool alike = __shfl_sync(~0u, node, 0) == __shfl_sync(~0u, node, 31);
  if (alike)
    for (int offset = 16; offset > 0; offset /= 2)
      for (int k = 0; k < 3; ++k) {
        e.low[k] = min(e.low[k], __shfl_xor_sync(~0u, e.low[k], offset));
        e.high[k] = max(e.high[k], __shfl_xor_sync(~0u, e.high[k], offset));
      }
  if (alike && threadIdx.x % 32 != 0) return;
  for (int k = 0; k < 3; ++k) {
    atomicMin(&extents[node].low[k], e.low[k]);
    atomicMax(&extents[node].high[k], e.high[k]);
  }
}

template <class T>
__global__ void make_keys(const T* points, const int32_t* order, int64_t n, int level, const Extent* extents,
                          uint64_t* keys) {
  const int64_t at = global_thread();
  if (at >= n) return;
  const int64_t node = node_of(n, level, at);
  keys[at] = split_key(node, extents[node], points + 3 * int64_t(order[at]));
}

template <class T>
__global__ void gather_points(const T* points, const int32_t* order, int64_t n, TreePoint<T>* sorted) {
  const int64_t at = global_thread();
  if (at >= n) return;
  const T* x = points + 3 * int64_t(order[at]);
  sorted[at] = {{x[0], x[1], x[2]}, order[at]};
}

template <class T>
__global__ void leaf_boxes(const TreePoint<T>* points, int64_t n, int level, Box<T>* boxes) {
  const int64_t leaf = global_thread(), leaves = int64_t(1) << level;
  if (leaf < leaves)
    boxes[leaves + leaf] = box_of_leaf(points, first_point(n, level, leaf), first_point(n, level, leaf + 1));
}

template <class T>
__global__ void inner_boxes(int level, Box<T>* boxes) {
  const int64_t i = global_thread(), nodes = int64_t(1) << level;
  if (i >= nodes) return;
  Box<T> box = boxes[2 * (nodes + i)];
  box.add(boxes[2 * (nodes + i) + 1]);
  boxes[nodes + i] = box;
}

template <class T>
__global__ void __launch_bounds__(kSearchThreads) search(BoxTree<T> tree, T* out) {
  const int64_t at = global_thread();
  if (at < tree.n) out[tree.points[at].index] = tree.nearest(at).mean();
}

// Finds the indices of the finite points, ascending; returns their number.
template <class T>
int64_t select_finite(const T* points, int64_t n, int32_t* indexes, const Queue& queue) {
  const auto stream = static_cast<cudaStream_t>(queue.stream);
  const thrust::counting_iterator<int32_t> all(0);
  int64_t* count_on_device = queue.array<int64_t>(1);
  size_t bytes = 0;
  GS_CUDA_CHECK(cub::DeviceSelect::If(nullptr, bytes, all, indexes, count_on_device, n, IsFinite<T>{points}, stream));
  GS_CUDA_CHECK(cub::DeviceSelect::If(queue.array<char>(bytes), bytes, all, indexes, count_on_device, n,
                                      IsFinite<T>{points}, stream));
  int64_t count = 0;
  GS_CUDA_CHECK(cudaMemcpyAsync(&count, count_on_device, sizeof count, cudaMemcpyDeviceToHost, stream));
  GS_CUDA_CHECK(cudaStreamSynchronize(stream));
  return count;
}

// Sorts the points' indices into the tree's order.
template <class T>
void sort_into_tree(const T* points, int64_t n, cub::DoubleBuffer<int32_t>& order, const Queue& queue) {
  const auto stream = static_cast<cudaStream_t>(queue.stream);
  const int last = leaf_level(n);
  if (last == 0) return;
  cub::DoubleBuffer<uint64_t> keys(queue.array<uint64_t>(n), queue.array<uint64_t>(n));
  Extent* extents = queue.array<Extent>(size_t(1) << (last - 1));
  size_t most = 0;
  GS_CUDA_CHECK(cub::DeviceRadixSort::SortPairs(nullptr, most, keys, order, n, 0, 64, stream));
  char* memory = queue.array<char>(most);
  for (int level = 0; level < last; ++level) {
    const int64_t nodes = int64_t(1) << level;
    clear_extents<<<blocks(nodes, kThreads), kThreads, 0, stream>>>(extents, nodes);
    check_launch("clear_extents");
    measure<<<blocks(n, kThreads), kThreads, 0, stream>>>(points, order.Current(), n, level, extents);
    check_launch("measure");
    make_keys<<<blocks(n, kThreads), kThreads, 0, stream>>>(points, order.Current(), n, level, extents, keys.Current());
    check_launch("make_keys");
    size_t bytes = most;
    GS_CUDA_CHECK(cub::DeviceRadixSort::SortPairs(memory, bytes, keys, order, n, 0, 32 + level, stream));
  }
}

}  // namespace

template <class T>
void mean_distance2(const T* points, int64_t n_all, T* out, const Queue& queue) {
  if (n_all == 0) return;
  const auto stream = static_cast<cudaStream_t>(queue.stream);
  GS_CUDA_CHECK(cudaMemsetAsync(out, 0, n_all * sizeof(T), stream));  // the result of points that are not finite
  int32_t* indexes = queue.array<int32_t>(n_all);
  const int64_t n = select_finite(points, n_all, indexes, queue);
  if (n == 0) return;
  cub::DoubleBuffer<int32_t> order(indexes, queue.array<int32_t>(n));
  sort_into_tree(points, n, order, queue);

  const int last = leaf_level(n);
  TreePoint<T>* sorted = queue.array<TreePoint<T>>(n);
  Box<T>* boxes = queue.array<Box<T>>(size_t(2) << last);
  gather_points<<<blocks(n, kThreads), kThreads, 0, stream>>>(points, order.Current(), n, sorted);
  check_launch("gather_points");
  leaf_boxes<<<blocks(int64_t(1) << last, kThreads), kThreads, 0, stream>>>(sorted, n, last, boxes);
  check_launch("leaf_boxes");
  for (int level = last - 1; level >= 0; --level) {
    inner_boxes<<<blocks(int64_t(1) << level, kThreads), kThreads, 0, stream>>>(level, boxes);
    check_launch("inner_boxes");
  }
  const BoxTree<T> tree{sorted, boxes, n, last};
  search<<<blocks(n, kSearchThreads), kSearchThreads, 0, stream>>>(tree, out);
  check_launch("search");
}

template void mean_distance2(const float*, int64_t, float*, const Queue&);
template void mean_distance2(const double*, int64_t, double*, const Queue&);

}  // namespace gs
