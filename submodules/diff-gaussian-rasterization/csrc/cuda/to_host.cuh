#pragma once
// Numbers that the host needs before it can go on.
#include "queue.cuh"

namespace gs {
namespace cuda {

// Copies to the host what was computed up to here. Waiting for it is no waiting for what is queued since.
template <class T>
class ToHost {
  static_assert(sizeof(T) <= sizeof(int64_t));

 public:
  ToHost(const Queue& queue, const T* from, int count)
      : host_(reinterpret_cast<T*>(queue.pinned(queue.context, count))) {
    GS_CUDA_CHECK(cudaEventCreateWithFlags(&arrived_, cudaEventDisableTiming));
    const cudaStream_t stream = stream_of(queue);
    GS_CUDA_CHECK(cudaMemcpyAsync(host_, from, count * sizeof(T), cudaMemcpyDeviceToHost, stream));
    GS_CUDA_CHECK(cudaEventRecord(arrived_, stream));
  }
  ToHost(const ToHost&) = delete;
  // Waits, too: after an error in between the numbers must not come into memory that is another's by then.
  ~ToHost() { cudaEventSynchronize(arrived_), cudaEventDestroy(arrived_); }

  const T* wait() const {
    GS_CUDA_CHECK(cudaEventSynchronize(arrived_));
    return host_;
  }

 private:
  T* host_;
  cudaEvent_t arrived_;
};

}  // namespace cuda
}  // namespace gs
