#pragma once
// Tiles in the order in which blocks should take them: a long list that is started last keeps one processor busy while
// the others are done.
#include <cstdint>

#include "gs/cuda_check.h"
#include "gs/cuda_queue.h"

namespace gs {
namespace cuda {

constexpr int kOrderThreads = 1024;
constexpr int kLengthClasses = 256;  // eight to a doubling

// Longer lists have smaller classes.
__device__ inline int length_class(int64_t length) {
  const uint32_t bits = __float_as_uint(float(length) + 1);     // 1 to 2^32
  return kLengthClasses - 1 - int((bits - 0x3f800000u) >> 20);  // exponent and three bits of the mantissa
}

// One block sorts tiles by class. Within a class they lie in any order, which no result depends on.
template <class Length>
__global__ void __launch_bounds__(kOrderThreads) order_tiles_kernel(int tiles, Length length, int32_t* order) {
  __shared__ int32_t places[kLengthClasses];
  for (int c = threadIdx.x; c < kLengthClasses; c += kOrderThreads) places[c] = 0;
  __syncthreads();
  for (int t = threadIdx.x; t < tiles; t += kOrderThreads) atomicAdd(&places[length_class(length(t))], 1);
  __syncthreads();
  if (threadIdx.x == 0) {
    int32_t before = 0;
    for (int c = 0; c < kLengthClasses; ++c) {
      const int32_t count = places[c];
      places[c] = before;
      before += count;
    }
  }
  __syncthreads();
  for (int t = threadIdx.x; t < tiles; t += kOrderThreads) order[atomicAdd(&places[length_class(length(t))], 1)] = t;
}

static __global__ void __launch_bounds__(kOrderThreads) keep_tiles_kernel(int tiles, int32_t* order) {
  const int t = blockIdx.x * kOrderThreads + threadIdx.x;
  if (t < tiles) order[t] = t;
}

// Tiles with the longest lists first; in the usual order where one block would take too long to sort them.
template <class Length>
const int32_t* heaviest_first(const Queue& queue, int64_t tiles, const Length& length) {
  constexpr int64_t kMost = 16384;
  const auto stream = static_cast<cudaStream_t>(queue.stream);
  int32_t* order = queue.array<int32_t>(tiles);
  if (tiles <= kMost)
    order_tiles_kernel<<<1, kOrderThreads, 0, stream>>>(int(tiles), length, order);
  else
    keep_tiles_kernel<<<unsigned((tiles + kOrderThreads - 1) / kOrderThreads), kOrderThreads, 0, stream>>>(int(tiles),
                                                                                                           order);
  check_launch("order_tiles");
  return order;
}

}  // namespace cuda
}  // namespace gs
