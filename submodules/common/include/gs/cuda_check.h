#pragma once
// CUDA's errors as exceptions.
#include <cuda_runtime.h>

#include <stdexcept>
#include <string>

namespace gs {

inline void check_cuda(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(status));
}

// For use after a kernel launch: a bad configuration or a missing architecture shows here.
inline void check_launch(const char* kernel) { check_cuda(cudaGetLastError(), kernel); }

}  // namespace gs

#define GS_CUDA_CHECK(expression) ::gs::check_cuda((expression), #expression)
