#pragma once
// Helpers of all ops: checks, and calls of a backend.
#include <type_traits>

#include "backend.h"
#include "gs/isa.h"
#include "gs/torch_executor.h"
#include "gs/torch_operators.h"
#include "gs/torch_tensor.h"

namespace gs::ops {

// How far the calling thread's ops run ahead of a GPU, as `run_ahead_` has set it; null: the host waits for lengths.
const gs::Ahead* ahead();

// The word at which kernels do nothing (gs::Queue::halted), or null.
inline const int32_t* halted() { return ahead() ? ahead()->halted : nullptr; }

constexpr const char* kFloatAlone = "the CUDA backend computes in float32, got float64: pass .float(), or use the CPU";

// TypeError for None and for another dtype or device, ValueError for other sizes; a size of -1 allows any.
inline void check_tensor(const Tensor& t, const char* name, ScalarType type, Device device, Sizes sizes) {
  check_given(t, name);
  GS_CHECK_TYPE(has_dtype(t, type) && t.device() == device, name, " must be ", type, " on ", device, ", got ",
                t.scalar_type(), " on ", t.device());
  bool fits = t.dim() == int64_t(sizes.size());
  for (size_t axis = 0; fits && axis < sizes.size(); ++axis) fits = sizes[axis] < 0 || t.size(axis) == sizes[axis];
  GS_CHECK_VALUE(fits, name, " must be ", sizes, ", where -1 is any size, got ", t.sizes());
}

// The same for a tensor that is converted to the dtype and device of others: both precisions are taken.
inline void check_precise(const Tensor& t, const char* name, Sizes sizes) {
  check_given(t, name);
  GS_CHECK_TYPE(has_dtype(t, ScalarType::Float) || has_dtype(t, ScalarType::Double), name,
                " must be float32 or float64, got ", t.scalar_type());
  GS_CHECK_VALUE(same(t.sizes(), sizes), name, " must be ", sizes, ", got ", t.sizes());
}

// Calls f with a zero of the C++ type behind the dtype.
template <class F>
void with_scalar(ScalarType type, const F& f) {
  GS_CHECK(is_floating(type), "the dtype must be float32 or float64, got ", type);
  if (type == ScalarType::Float)
    f(float());
  else
    f(double());
}

}  // namespace gs::ops

// Runs a backend's function on the device of the tensor `like`.
#ifdef GS_CUDA
#define GS_RUN(T, like, fn, ...)                              \
  if (!(like).is_cuda()) {                                    \
    GS_DISPATCH(fn, gs::torch_executor(), __VA_ARGS__);       \
  } else if constexpr (std::is_same_v<T, float>) {            \
    gs::TorchQueue queue((like).device(), gs::ops::halted()); \
    gs::cuda::fn(queue.queue(), __VA_ARGS__);                 \
  } else {                                                    \
    GS_CHECK(false, gs::ops::kFloatAlone);                    \
  }
#else
#define GS_RUN(T, like, fn, ...) GS_DISPATCH(fn, gs::torch_executor(), __VA_ARGS__)
#endif
