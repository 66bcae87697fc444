#pragma once
// What GPUs have from compute capability 8.0 on, and a plain form of it for those of 7.5, with the same bytes. With
// -DGS_PLAIN_GPU every GPU takes the plain forms and launches no kernel early (cuda_launch.h), so that newer ones can
// test both.
#include <cuda_pipeline.h>
#include <cuda_runtime.h>

#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800 && !defined(GS_PLAIN_GPU)
#define GS_PLAIN_GPU
#endif

namespace gs {
namespace plain {

template <class T, class Combine>
__device__ __forceinline__ T warp_reduce(T value, const Combine& combine) {
  for (int step = 16; step; step /= 2) value = combine(value, __shfl_xor_sync(~0u, value, step));
  return value;
}
template <class T>
__device__ __forceinline__ T warp_max(T mine) {
  return warp_reduce(mine, [](T a, T b) { return a > b ? a : b; });
}
__device__ __forceinline__ unsigned warp_min(unsigned mine) {
  return warp_reduce(mine, [](unsigned a, unsigned b) { return a < b ? a : b; });
}
__device__ __forceinline__ unsigned warp_or(unsigned mine) {
  return warp_reduce(mine, [](unsigned a, unsigned b) { return a | b; });
}
template <class V>
__device__ __forceinline__ void start_copy(V* shared, const V* global) {
  *shared = *global;
}

constexpr int kThreadsAtOnce = 1024;  // that a multiprocessor holds

}  // namespace plain

#ifdef GS_PLAIN_GPU
using namespace plain;
#else

// All lanes of a warp call these, and each gets the largest or the least value, or all bits.
template <class T>
__device__ __forceinline__ T warp_max(T mine) {
  return __reduce_max_sync(~0u, mine);
}
__device__ __forceinline__ unsigned warp_min(unsigned mine) { return __reduce_min_sync(~0u, mine); }
__device__ __forceinline__ unsigned warp_or(unsigned mine) { return __reduce_or_sync(~0u, mine); }

// Copies 4 or 16 bytes to shared memory; they are there after __pipeline_commit and __pipeline_wait_prior.
template <class V>
__device__ __forceinline__ void start_copy(V* shared, const V* global) {
  __pipeline_memcpy_async(shared, global, sizeof(V));
}

constexpr int kThreadsAtOnce = 1536;

#endif

// Blocks that a multiprocessor is asked to hold at once: `wanted`, if it has the threads.
constexpr int blocks_at_once(int wanted, int threads) {
  return wanted * threads > kThreadsAtOnce ? kThreadsAtOnce / threads : wanted;
}

}  // namespace gs
