#pragma once
// A queue for the emulated kernels, for tests.
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <vector>

#include "emulation.h"
#include "gs/cuda_queue.h"

namespace gs::emulation {

// Memory of exact sizes, so that a sanitizer sees an access outside. It is freed when released, or with this object.
class Memory {
 public:
  Queue queue() { return {nullptr, &allocate, &release, &pinned, this}; }

 private:
  static void* allocate(void* context, size_t bytes) {
    auto& pieces = static_cast<Memory*>(context)->pieces_;
    void* piece = nullptr;
    if (posix_memalign(&piece, kAlignment, bytes)) throw std::bad_alloc();
    std::memset(piece, 0x7f, bytes);  // floats of 3.4e38, because no kernel may rely on zeros
    pieces.emplace_back(piece, &std::free);
    return piece;
  }
  static void release(void* context, const void* memory) {
    auto& pieces = static_cast<Memory*>(context)->pieces_;
    pieces.erase(std::find_if(pieces.begin(), pieces.end(), [=](const auto& one) { return one.get() == memory; }));
  }
  static int64_t* pinned(void* context, int64_t count) {
    return static_cast<int64_t*>(allocate(context, count * sizeof(int64_t)));
  }
  static constexpr size_t kAlignment = 512;  // that of torch's allocator
  std::vector<std::unique_ptr<void, void (*)(void*)>> pieces_;
};

constexpr Order kOrders[] = {Order::forward, Order::backward, Order::shuffled};

}  // namespace gs::emulation
