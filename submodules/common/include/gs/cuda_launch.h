#pragma once
// Launches kernels so that one may come to the multiprocessors while the one before it ends (programmatic dependent
// launch): its blocks then wait in begin_work, not in the queue.
#include <cuda_runtime.h>

#include <utility>

#include "cuda_check.h"
#include "cuda_queue.h"

namespace gs {

// What every kernel that `launch` launches calls first: waits for the work before it, and tells whether that was halted
// (cuda_queue.h). Memory may not be touched before.
__device__ __forceinline__ bool begin_work(const int32_t* halted) {
#if __CUDA_ARCH__ >= 900 && !defined(GS_PLAIN_GPU)
  cudaTriggerProgrammaticLaunchCompletion();
  cudaGridDependencySynchronize();
#endif
  return !(halted && *halted != 0);
}

// An empty kernel, of which only its code's version is asked.
static __global__ void version_kernel() {}

// Whether kernels of this library wait in begin_work. Tried with compute capability 9 alone.
inline bool waits_in_kernels() {
#ifdef GS_PLAIN_GPU  // gs/gpu_forms.h
  return false;
#else
  int device, major;
  GS_CUDA_CHECK(cudaGetDevice(&device));
  GS_CUDA_CHECK(cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device));
  cudaFuncAttributes version;
  GS_CUDA_CHECK(cudaFuncGetAttributes(&version, version_kernel));
  return major == 9 && version.ptxVersion >= 90;
#endif
}

// Launches a kernel whose first parameter is Queue::halted. Throws std::runtime_error that names it.
template <class... Parameters, class... Arguments>
void launch(const Queue& queue, const char* name, void (*kernel)(const int32_t*, Parameters...), unsigned blocks,
            unsigned threads, Arguments&&... arguments) {
  static const bool overlaps = waits_in_kernels();
  cudaLaunchAttribute early{};
  early.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  early.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = dim3(blocks), config.blockDim = dim3(threads);
  config.stream = static_cast<cudaStream_t>(queue.stream);
  config.attrs = &early, config.numAttrs = overlaps ? 1 : 0;
  check_cuda(cudaLaunchKernelEx(&config, kernel, queue.halted, std::forward<Arguments>(arguments)...), name);
}

}  // namespace gs
