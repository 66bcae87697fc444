#pragma once
// Replaces CUDA's header of this name. Copies happen at the wait, as late as possible.
#include <vector>

#include "cuda_runtime.h"

namespace gs::emulation {
struct Copy {
  void* to;
  const void* from;
  size_t bytes;
};
inline std::vector<Copy> copies[1024];  // by thread
}  // namespace gs::emulation

inline void __pipeline_memcpy_async(void* to, const void* from, size_t bytes) {
  if (uintptr_t(to) % bytes || uintptr_t(from) % bytes) __builtin_trap();
  gs::emulation::copies[threadIdx.x].push_back({to, from, bytes});
}
inline void __pipeline_commit() {}
inline void __pipeline_wait_prior(int) {
  for (const auto& copy : gs::emulation::copies[threadIdx.x]) std::memcpy(copy.to, copy.from, copy.bytes);
  gs::emulation::copies[threadIdx.x].clear();
}
