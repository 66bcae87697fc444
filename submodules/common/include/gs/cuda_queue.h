#pragma once
// Where a CUDA backend runs and gets its temporary memory from; the host framework fills it in.
#include <cstddef>
#include <cstdint>

namespace gs {

struct Queue {
  void* stream;  // cudaStream_t
  // Device memory that lives until the call that it was handed to has been enqueued and its stream has used it.
  void* (*allocate)(void* context, size_t bytes);
  // Gives such memory back before the call ends: whatever is enqueued later may get it.
  void (*release)(void* context, const void* memory);
  // Page-locked host memory for numbers, for as long: a copy to it does not hold up the host.
  int64_t* (*pinned)(void* context, int64_t count);
  void* context;

  template <class T>
  T* array(size_t count) const {
    return static_cast<T*>(allocate(context, count * sizeof(T)));
  }
};

}  // namespace gs
