#pragma once
// The stream that a CUDA backend runs on, and its source of temporary memory. The host framework fills it in.
#include <cstddef>
#include <cstdint>

namespace gs {

struct Queue {
  void* stream;  // cudaStream_t
  // Allocates device memory. It lives until the work that the call enqueues has used it.
  void* (*allocate)(void* context, size_t bytes);
  // Gives such memory back before the call ends; work that is enqueued later may get it.
  void (*release)(void* context, const void* memory);
  // Allocates page-locked host memory with the same lifetime; the host does not wait for a copy to it.
  int64_t* (*pinned)(void* context, int64_t count);
  void* context;
  // A word on the device, or null. Once a kernel has found too little room for its results it sets the word, and from
  // then on no kernel changes anything: the host, which runs ahead, makes room and repeats the work.
  const int32_t* halted = nullptr;

  template <class T>
  T* array(size_t count) const {
    return static_cast<T*>(allocate(context, count * sizeof(T)));
  }
};

}  // namespace gs
