#pragma once
// A Queue over torch's current stream and caching allocator. For csrc/torch alone, in CUDA builds.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <c10/cuda/CUDACachingAllocator.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

#include <algorithm>
#include <vector>

#include "gs/cuda_queue.h"

namespace gs {

// Serves one call: sets the device, and keeps the call's temporary memory until it goes out of scope. That is late
// enough, because torch's allocator reuses memory in stream order.
class TorchQueue {
 public:
  explicit TorchQueue(at::Device device, const int32_t* halted = nullptr) : guard_(device), halted_(halted) {}

  Queue queue() { return {c10::cuda::getCurrentCUDAStream().stream(), &allocate, &release, &pinned, this, halted_}; }

 private:
  static void* allocate(void* context, size_t bytes) {
    // Calls the allocator itself: a step has some fifteen arrays, and the dispatcher would make a tensor for each.
    auto& memory = static_cast<TorchQueue*>(context)->memory_;
    memory.push_back(c10::cuda::CUDACachingAllocator::get()->allocate(bytes));
    return memory.back().get();
  }

  static void release(void* context, const void* memory) {
    auto& all = static_cast<TorchQueue*>(context)->memory_;
    const auto is_it = [=](const c10::DataPtr& one) { return one.get() == memory; };
    all.erase(std::find_if(all.begin(), all.end(), is_it));
  }

  static int64_t* pinned(void* context, int64_t count) {
    auto& numbers = static_cast<TorchQueue*>(context)->numbers_;
    numbers.push_back(at::empty({count}, at::TensorOptions(at::kLong).pinned_memory(true)));
    return numbers.back().mutable_data_ptr<int64_t>();
  }

  c10::cuda::CUDAGuard guard_;
  const int32_t* halted_;
  std::vector<c10::DataPtr> memory_;
  std::vector<at::Tensor> numbers_;
};

}  // namespace gs
