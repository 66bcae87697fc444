#pragma once
// Brings the host the numbers that it needs before it can continue.
#include "queue.cuh"

namespace gs {
namespace cuda {

// Copies numbers to the host once the work queued so far has computed them. Waiting for them does not wait for work
// queued later.
template <class T>
class HostNumbers {
  static_assert(sizeof(T) <= sizeof(int64_t));

 public:
  HostNumbers(const Queue& queue, const T* from, int count)
      : host_(reinterpret_cast<T*>(queue.pinned(queue.context, count))) {
    GS_CUDA_CHECK(cudaEventCreateWithFlags(&arrived_, cudaEventDisableTiming));
    const cudaStream_t stream = stream_of(queue);
    GS_CUDA_CHECK(cudaMemcpyAsync(host_, from, count * sizeof(T), cudaMemcpyDeviceToHost, stream));
    GS_CUDA_CHECK(cudaEventRecord(arrived_, stream));
  }
  HostNumbers(const HostNumbers&) = delete;
  // Waits as well: after an error the copy must not arrive in memory that has another owner by then.
  ~HostNumbers() { cudaEventSynchronize(arrived_), cudaEventDestroy(arrived_); }

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
