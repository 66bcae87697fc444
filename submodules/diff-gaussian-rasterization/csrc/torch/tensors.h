#pragma once
// Helpers of all ops: contiguous tensors, words for messages, calls of a backend, and registration.
#include <ATen/core/Tensor.h>
#include <torch/library.h>

#include <optional>
#include <string>
#include <type_traits>

#include "ahead.h"
#include "backend.h"
#include "gs/isa.h"
#include "gs/torch_executor.h"
#ifdef GS_CUDA
#include "gs/torch_queue.h"
#endif

namespace gs::ops {

using at::Tensor;
using MaybeTensor = std::optional<Tensor>;

constexpr const char* kFloatAlone = "the CUDA backend computes in float32, got float64: pass .float(), or use the CPU";

// Returns `t` contiguous, with the dtype and on the device of `like`. Asks first: torch's conversion costs time even
// where there is nothing to convert, and a step makes some ten.
inline Tensor converted(const Tensor& t, const Tensor& like) {
  const bool fits = t.scalar_type() == like.scalar_type() && t.device() == like.device();
  return fits ? t.contiguous() : t.to(like.options()).contiguous();
}

// A shape and a dtype as Python writes them.
inline std::string in_words(at::IntArrayRef sizes) {
  std::string words;
  for (int64_t size : sizes) words += (words.empty() ? "" : ", ") + std::to_string(size);
  return "(" + words + (sizes.size() == 1 ? ",)" : ")");
}
inline std::string in_words(at::ScalarType type) { return "torch." + std::string(c10::getDtypeNames(type).first); }

// TypeError for Python's None, which arrives as an undefined tensor where the schema wants one.
inline void check_given(const Tensor& t, const char* name) {
  TORCH_CHECK_TYPE(t.defined(), name, " must be a tensor, got None");
}

// TypeError for None and for another dtype or device, ValueError for other sizes; a size of -1 allows any.
inline void check_tensor(const Tensor& t, const char* name, at::ScalarType type, at::Device device,
                         at::IntArrayRef sizes) {
  check_given(t, name);
  TORCH_CHECK_TYPE(t.scalar_type() == type && t.device() == device, name, " must be ", in_words(type), " on ", device,
                   ", got ", in_words(t.scalar_type()), " on ", t.device());
  bool fits = t.dim() == int64_t(sizes.size());
  for (size_t axis = 0; fits && axis < sizes.size(); ++axis) fits = sizes[axis] < 0 || t.size(axis) == sizes[axis];
  TORCH_CHECK_VALUE(fits, name, " must be ", in_words(sizes), ", where -1 is any size, got ", in_words(t.sizes()));
}

// The same for a tensor that is converted to the dtype and device of others: both precisions are taken.
inline void check_precise(const Tensor& t, const char* name, at::IntArrayRef sizes) {
  check_given(t, name);
  TORCH_CHECK_TYPE(t.scalar_type() == at::kFloat || t.scalar_type() == at::kDouble, name,
                   " must be float32 or float64, got ", in_words(t.scalar_type()));
  TORCH_CHECK_VALUE(t.sizes() == sizes, name, " must be ", in_words(sizes), ", got ", in_words(t.sizes()));
}

// Calls f with a zero of the C++ type behind the dtype.
template <class F>
void with_scalar(at::ScalarType type, const F& f) {
  TORCH_CHECK(type == at::kFloat || type == at::kDouble, "the dtype must be float32 or float64, got ", in_words(type));
  if (type == at::kFloat)
    f(float());
  else
    f(double());
}

// Defines an op by its schema and registers its function, for the CPU and in a build with CUDA for GPUs too.
template <class Function>
void define(torch::Library& library, const std::string& schema, Function* function) {
  library.def(schema.c_str());
  const std::string name = schema.substr(0, schema.find('('));
  library.impl(name.c_str(), torch::dispatch(c10::DeviceType::CPU, function));
#ifdef GS_CUDA
  library.impl(name.c_str(), torch::dispatch(c10::DeviceType::CUDA, function));
#endif
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
    TORCH_CHECK(false, gs::ops::kFloatAlone);                 \
  }
#else
#define GS_RUN(T, like, fn, ...) GS_DISPATCH(fn, gs::torch_executor(), __VA_ARGS__)
#endif
