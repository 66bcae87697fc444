#pragma once
// Queue over torch's current stream and caching allocator. Only ops.cpp includes this, in CUDA builds.
#include <ATen/ops/empty.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

#include <vector>

#include "gs/cuda_queue.h"

namespace gs {

// For one call: sets the device, and keeps the call's temporary memory until it goes out of scope. Torch's allocator
// hands memory on in stream order, so that is soon enough.
class TorchQueue {
 public:
  explicit TorchQueue(at::Device device) : guard_(device), device_(device) {}

  Queue queue() { return {c10::cuda::getCurrentCUDAStream().stream(), &allocate, this}; }

 private:
  static void* allocate(void* context, size_t bytes) {
    auto* self = static_cast<TorchQueue*>(context);
    self->memory_.push_back(at::empty({int64_t(bytes)}, at::TensorOptions().dtype(at::kByte).device(self->device_)));
    return self->memory_.back().mutable_data_ptr();
  }

  c10::cuda::CUDAGuard guard_;
  at::Device device_;
  std::vector<at::Tensor> memory_;
};

}  // namespace gs
