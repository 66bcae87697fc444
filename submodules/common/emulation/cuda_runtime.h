#pragma once
// Replaces CUDA's header of this name; see emulation.h.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

#include "emulation.h"

#define __CUDA_ARCH__ 900
#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __noinline__
#define __shared__ static
#define __launch_bounds__(...)
#define __maxnreg__(...)
#define __grid_constant__
#define __align__(bytes) __attribute__((aligned(bytes)))

using std::isfinite;
using std::max;
using std::min;

using cudaStream_t = void*;
enum cudaError_t { cudaSuccess, cudaErrorInvalidValue };
enum cudaMemcpyKind { cudaMemcpyDeviceToHost, cudaMemcpyDeviceToDevice };
enum cudaFuncAttribute { cudaFuncAttributeMaxDynamicSharedMemorySize };
inline cudaError_t cudaGetLastError() { return cudaSuccess; }
inline const char* cudaGetErrorString(cudaError_t) { return "an error of the emulation"; }
inline cudaError_t cudaMemsetAsync(void* to, int value, size_t bytes, cudaStream_t) {
  return std::memset(to, value, bytes), cudaSuccess;
}
inline cudaError_t cudaMemcpyAsync(void* to, const void* from, size_t bytes, cudaMemcpyKind, cudaStream_t) {
  return std::memcpy(to, from, bytes), cudaSuccess;
}
inline cudaError_t cudaStreamSynchronize(cudaStream_t) { return cudaSuccess; }
// Kernels run at their launch, so every event has already happened.
using cudaEvent_t = void*;
constexpr unsigned cudaEventDisableTiming = 2;
inline cudaError_t cudaEventCreateWithFlags(cudaEvent_t* event, unsigned) { return *event = nullptr, cudaSuccess; }
inline cudaError_t cudaEventRecord(cudaEvent_t, cudaStream_t) { return cudaSuccess; }
inline cudaError_t cudaEventSynchronize(cudaEvent_t) { return cudaSuccess; }
inline cudaError_t cudaEventDestroy(cudaEvent_t) { return cudaSuccess; }
template <class K>
cudaError_t cudaFuncSetAttribute(K, cudaFuncAttribute, int) {
  return cudaSuccess;
}

struct alignas(8) float2 {
  float x, y;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
struct alignas(8) int2 {
  int x, y;
};
struct alignas(16) int4 {
  int x, y, z, w;
};
struct alignas(4) uchar4 {
  unsigned char x, y, z, w;
};
struct alignas(16) uint4 {
  unsigned x, y, z, w;
};
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline int2 make_int2(int x, int y) { return {x, y}; }
inline int4 make_int4(int x, int y, int z, int w) { return {x, y, z, w}; }

inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __popcll(unsigned long long bits) { return __builtin_popcountll(bits); }
inline int __ffs(int bits) { return __builtin_ffs(bits); }
inline int __ffsll(long long bits) { return __builtin_ffsll(bits); }
inline int __clz(int bits) { return bits ? __builtin_clz(unsigned(bits)) : 32; }
inline float __fmul_rn(float a, float b) { return a * b; }
inline double __dmul_rn(double a, double b) { return a * b; }
inline unsigned __float_as_uint(float a) {
  unsigned bits;
  std::memcpy(&bits, &a, sizeof bits);
  return bits;
}
template <class T>
T __ldcg(const T* at) {
  return *at;
}
template <class T>
T __ldcs(const T* at) {
  return *at;
}
template <class T>
void __stcs(T* at, T value) {
  *at = value;
}
inline float __fdividef(float a, float b) { return a / b; }
inline float __frcp_rn(float a) { return 1 / a; }
inline float __saturatef(float a) { return a > 1 ? 1.0f : a > 0 ? a : 0.0f; }

inline void __syncthreads() { gs::emulation::meet(gs::emulation::Meeting::block, "__syncthreads"); }
inline int __syncthreads_or(int mine) { return gs::emulation::any_of_block(mine != 0); }
inline void __syncwarp(unsigned mask = ~0u) { gs::emulation::exchange(0, "__syncwarp", mask); }
inline unsigned __ballot_sync(unsigned mask, int mine) {
  return gs::emulation::reduce(mine ? 1u << gs::emulation::lane() : 0u, "__ballot_sync", mask,
                               [](unsigned a, unsigned b) { return a | b; });
}
inline int __any_sync(unsigned mask, int mine) { return __ballot_sync(mask, mine) != 0; }
inline int __all_sync(unsigned mask, int mine) { return __ballot_sync(mask, mine) == ~0u; }
template <class T>
T __reduce_max_sync(unsigned mask, T mine) {
  return gs::emulation::reduce(mine, "__reduce_max_sync", mask, [](T a, T b) { return a > b ? a : b; });
}
inline unsigned __reduce_min_sync(unsigned mask, unsigned mine) {
  return gs::emulation::reduce(mine, "__reduce_min_sync", mask, [](unsigned a, unsigned b) { return a < b ? a : b; });
}
inline unsigned __reduce_or_sync(unsigned mask, unsigned mine) {
  return gs::emulation::reduce(mine, "__reduce_or_sync", mask, [](unsigned a, unsigned b) { return a | b; });
}
template <class T>
T __shfl_sync(unsigned mask, T value, int from) {
  return gs::emulation::shuffle(value, from & 31, "__shfl_sync", mask);
}
template <class T>
T __shfl_xor_sync(unsigned mask, T value, int bits) {
  return gs::emulation::shuffle(value, gs::emulation::lane() ^ bits, "__shfl_xor_sync", mask);
}
template <class T>
T __shfl_up_sync(unsigned mask, T value, unsigned by) {
  return gs::emulation::shuffle(value, gs::emulation::lane() - int(by), "__shfl_up_sync", mask);
}
template <class T>
T __shfl_down_sync(unsigned mask, T value, unsigned by) {
  return gs::emulation::shuffle(value, gs::emulation::lane() + int(by), "__shfl_down_sync", mask);
}

template <class T>
T atomicMax(T* at, T value) {
  const T before = *at;
  *at = before > value ? before : value;
  return before;
}
template <class T>
T atomicMin(T* at, T value) {
  const T before = *at;
  *at = before < value ? before : value;
  return before;
}
inline void __threadfence_system() {}  // nothing runs beside a kernel
template <class T>
T atomicOr(T* at, T value) {
  const T before = *at;
  *at = before | value;
  return before;
}
template <class T>
T atomicAdd(T* at, T value) {
  static_assert(!std::is_floating_point_v<T>, "no float atomics: their order changes the sum");
  const T before = *at;
  *at = before + value;
  return before;
}
