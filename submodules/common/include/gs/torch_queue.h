#pragma once
// A Queue over torch's current stream and caching allocator. For csrc/torch alone, in CUDA builds.
#include <torch/csrc/stable/accelerator.h>

#include <algorithm>
#include <vector>

#include "gs/cuda_queue.h"
#include "gs/torch_tensor.h"

// These are in torch's library of CUDA. A build with CUDA kernels also loads where there is none, and then calls none.
#pragma weak aoti_torch_get_current_cuda_stream
#pragma weak aoti_torch_cuda_caching_allocator_raw_alloc
#pragma weak aoti_torch_cuda_caching_allocator_raw_delete

namespace gs {

// Serves one call: sets the device, and keeps the call's temporary memory until it goes out of scope. That is late
// enough, because torch's allocator reuses memory in stream order.
class TorchQueue {
 public:
  explicit TorchQueue(Device device, const int32_t* halted = nullptr)
      : guard_(device.index()), index_(device.index()), halted_(halted) {}
  TorchQueue(const TorchQueue&) = delete;
  ~TorchQueue() {
    for (void* memory : memory_) aoti_torch_cuda_caching_allocator_raw_delete(memory);
  }

  Queue queue() {
    void* stream = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(index_, &stream));
    return {stream, &allocate, &release, &pinned, this, halted_};
  }

 private:
  static void* allocate(void* context, size_t bytes) {
    // Calls the allocator itself: a step has some fifteen arrays, and the dispatcher would make a tensor for each.
    void* memory = nullptr;
    const auto status = aoti_torch_cuda_caching_allocator_raw_alloc(bytes, &memory);
    if (status != TORCH_SUCCESS) raise_said(joined("CUDA out of memory. Tried to allocate ", bytes, " bytes"));
    static_cast<TorchQueue*>(context)->memory_.push_back(memory);
    return memory;
  }

  static void release(void* context, const void* memory) {
    auto& all = static_cast<TorchQueue*>(context)->memory_;
    const auto place = std::find(all.begin(), all.end(), memory);
    aoti_torch_cuda_caching_allocator_raw_delete(*place);
    all.erase(place);
  }

  static int64_t* pinned(void* context, int64_t count) {
    auto& numbers = static_cast<TorchQueue*>(context)->numbers_;
    const int64_t stride = 1;
    AtenTensorHandle made = nullptr;
    const auto status = aoti_torch_empty_strided_pinned(1, &count, &stride, aoti_torch_dtype_int64(),
                                                        aoti_torch_device_type_cpu(), -1, &made);
    if (status != TORCH_SUCCESS) raise_said(joined("the host is out of memory: ", count, " page-locked numbers"));
    numbers.emplace_back(made);
    return write<int64_t>(numbers.back());
  }

  torch::stable::accelerator::DeviceGuard guard_;
  int32_t index_;
  const int32_t* halted_;
  std::vector<void*> memory_;
  std::vector<Tensor> numbers_;
};

}  // namespace gs
