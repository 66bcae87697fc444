#pragma once
// An Executor over torch's intra-op pool, which torch.set_num_threads sizes. For csrc/torch alone.
#include <ATen/Parallel.h>

#include "gs/parallel.h"

namespace gs {

inline Executor torch_executor() {
  return {at::get_num_threads(), [](int64_t n, int64_t grain, const std::function<void(int64_t, int64_t)>& body) {
            at::parallel_for(0, n, grain, body);
          }};
}

}  // namespace gs
