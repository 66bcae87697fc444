#pragma once
// The host side's common uses of a Queue, and the mask of a whole warp.
#include <cuda_runtime.h>

#include "gs/cuda_check.h"
#include "gs/cuda_launch.h"
#include "gs/cuda_queue.h"
#include "gs/gpu_forms.h"

namespace gs {
namespace cuda {

constexpr unsigned kWarp = 0xffffffffu;

inline cudaStream_t stream_of(const Queue& queue) { return static_cast<cudaStream_t>(queue.stream); }

// Whether an earlier kernel halted the work (gs/cuda_queue.h), where `begin_work` was called.
__device__ __forceinline__ bool is_halted(const int32_t* halted) { return halted && *halted != 0; }

// The blocks of `threads` that `n` items need, a thread each.
inline unsigned blocks_for(int64_t n, int threads) { return unsigned((n + threads - 1) / threads); }

// CUB's functions are called twice: for the size of their memory, and with that memory.
template <class Call>
void with_memory(const Queue& queue, const Call& call) {
  size_t bytes = 0;
  GS_CUDA_CHECK(call(nullptr, bytes));
  void* memory = queue.allocate(queue.context, bytes);
  GS_CUDA_CHECK(call(memory, bytes));
  queue.release(queue.context, memory);
}

}  // namespace cuda
}  // namespace gs
