#pragma once
// An Executor over torch's intra-op pool, which torch.set_num_threads sizes; and the choice between it and a Queue. For
// csrc/torch alone.
#include <torch/csrc/stable/ops.h>

#include <atomic>
#include <exception>

#include "gs/parallel.h"
#include "gs/torch_tensor.h"
#ifdef GS_CUDA
#include "gs/torch_queue.h"
#endif

namespace gs {

inline Executor torch_executor() {
  return {int(torch::stable::get_num_threads()),
          [](int64_t n, int64_t grain, const std::function<void(int64_t, int64_t)>& body) {
            std::exception_ptr error;  // the interface would drop its type
            std::atomic_flag thrown = ATOMIC_FLAG_INIT;
            torch::stable::parallel_for(0, n, grain, [&](int64_t begin, int64_t end) {
              try {
                body(begin, end);
              } catch (...) {
                if (!thrown.test_and_set()) error = std::current_exception();
              }
            });
            if (error) std::rethrow_exception(error);
          }};
}

// Calls `run` with what a backend needs where a tensor is: a Queue on a GPU, an Executor elsewhere.
template <class Run>
void run_at(const Tensor& like, const Run& run, [[maybe_unused]] const int32_t* halted = nullptr) {
#ifdef GS_CUDA
  if (like.is_cuda()) {
    TorchQueue queue(like.device(), halted);
    return run(queue.queue());
  }
#endif
  run(torch_executor());
}

}  // namespace gs
