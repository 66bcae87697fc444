#pragma once
// Checks of what belongs to rows that may wait (gs::LazyRows).
#include "optim.h"

namespace gs::ops {

// What is known of `count` rows that wait, of the dtype and on the device of `like`.
template <class T>
gs::LazyRows<T> lazy_rows(int64_t count, const Tensor& like, const Tensor& last, const Tensor& ring,
                          const Tensor& taken) {
  check_tensor(last, "last", at::kInt, like.device(), {count});
  check_tensor(ring, "ring", like.scalar_type(), like.device(), {gs::kLazySteps, gs::kLazy, gs::kLazyConstants});
  check_tensor(taken, "taken", at::kInt, like.device(), {1});
  TORCH_CHECK_VALUE(last.is_contiguous() && ring.is_contiguous() && taken.is_contiguous() &&
                        reinterpret_cast<uintptr_t>(ring.const_data_ptr()) % 16 == 0,
                    "last, ring and taken must be contiguous, and the ring aligned to 16 bytes");
  return {last.mutable_data_ptr<int32_t>(), ring.mutable_data_ptr<T>(), taken.mutable_data_ptr<int32_t>()};
}

}  // namespace gs::ops
