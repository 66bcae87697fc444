#pragma once
// Tensors of operators through torch's stable interface: checks, memory and conversions. For csrc/torch alone.
#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "gs/torch_words.h"

namespace gs {

using MaybeTensor = std::optional<Tensor>;
using torch::headeronly::DeviceType;
using Shape = std::vector<int64_t>;
template <class T>
using List = torch::headeronly::HeaderOnlyArrayRef<T>;

// TypeError for Python's None, which arrives as an undefined tensor where the schema wants one.
inline void check_given(const Tensor& t, const char* name) {
  GS_CHECK_TYPE(t.defined(), name, " must be a tensor, got None");
}

// Not an operator: torch's own is missing in some of its versions.
inline bool same(Sizes one, Sizes two) { return one.equals(two); }

// Whether one of the two dtypes that are computed in.
inline bool is_floating(ScalarType type) { return type == ScalarType::Float || type == ScalarType::Double; }

// Asks for one dtype, where torch's own function tries several.
inline bool has_dtype(const Tensor& t, ScalarType type) {
  int32_t dtype = 0;
  aoti_torch_get_dtype(t.get(), &dtype);
  switch (type) {
    case ScalarType::Float:
      return dtype == aoti_torch_dtype_float32();
    case ScalarType::Double:
      return dtype == aoti_torch_dtype_float64();
    case ScalarType::Int:
      return dtype == aoti_torch_dtype_int32();
    case ScalarType::Long:
      return dtype == aoti_torch_dtype_int64();
    default:
      return t.scalar_type() == type;
  }
}

// Whether two tensors have one dtype and are on one device.
inline bool alike(const Tensor& one, const Tensor& two) {
  int32_t of_one[3] = {}, of_two[3] = {};
  for (auto [t, of] : {std::pair(&one, of_one), std::pair(&two, of_two)}) {
    aoti_torch_get_dtype(t->get(), &of[0]);
    aoti_torch_get_device_type(t->get(), &of[1]), aoti_torch_get_device_index(t->get(), &of[2]);
  }
  return std::equal(of_one, of_one + 3, of_two);
}

// The values of a tensor of T, to read and to write.
template <class T>
void check_holds(const Tensor& t) {
  int32_t dtype = 0;
  aoti_torch_get_dtype(t.get(), &dtype);
  GS_CHECK(dtype == aoti_torch_dtype<T>(), "a tensor has another dtype than that of its values: ", t.scalar_type());
}
template <class T>
const T* read(const Tensor& t) {
  check_holds<T>(t);
  return static_cast<const T*>(t.const_data_ptr());
}
template <class T>
T* write(const Tensor& t) {
  check_holds<T>(t);
  return static_cast<T*>(t.mutable_data_ptr());
}

// The strides of a contiguous tensor.
inline Shape strides_of(Sizes sizes) {
  Shape strides(sizes.size());
  int64_t values = 1;
  for (size_t axis = sizes.size(); axis-- > 0; values *= std::max<int64_t>(sizes[axis], 1)) strides[axis] = values;
  return strides;
}

namespace detail {

inline Tensor empty(Sizes sizes, int32_t dtype, const Tensor& like) {
  int32_t device = 0, index = 0;
  aoti_torch_get_device_type(like.get(), &device), aoti_torch_get_device_index(like.get(), &index);
  const Shape strides = strides_of(sizes);
  AtenTensorHandle made = nullptr;
  const auto status = aoti_torch_empty_strided(sizes.size(), sizes.data(), strides.data(), dtype, device, index, &made);
  const int64_t values = sizes.empty() ? 1 : sizes[0] * strides[0];
  if (status != TORCH_SUCCESS)
    raise_said(joined("out of memory. Tried to allocate ", values * aoti_torch_dtype_element_size(dtype), " bytes"));
  return Tensor(made);
}

}  // namespace detail

// Memory without content for a tensor of T, on the device of `like`.
template <class T>
Tensor empty(Sizes sizes, const Tensor& like) {
  return detail::empty(sizes, aoti_torch_dtype<T>(), like);
}

// The same with the dtype of `like`.
inline Tensor empty(Sizes sizes, const Tensor& like) {
  int32_t dtype = 0;
  aoti_torch_get_dtype(like.get(), &dtype);
  return detail::empty(sizes, dtype, like);
}

// A scalar with the dtype and on the device of `like`, which is the CPU.
template <class T>
Tensor scalar(T value, const Tensor& like) {
  Tensor out = empty({}, like);
  *write<T>(out) = value;
  return out;
}

// The value of a tensor of one float or double, for which the host waits.
template <class T>
T value_of(const Tensor& t) {
  T value{};
  if constexpr (std::is_same_v<T, float>) {
    TORCH_ERROR_CODE_CHECK(aoti_torch_item_float32(t.get(), &value));
  } else {
    TORCH_ERROR_CODE_CHECK(aoti_torch_item_float64(t.get(), &value));
  }
  return value;
}

// Asks first: torch's functions cost time even where there is nothing to do.
inline Tensor packed(const Tensor& t) {
  return heard([&] { return t.is_contiguous() ? t : torch::stable::contiguous(t); });
}

// The same where a GPU reads several words at a time: a copy unless the values begin at a multiple of so many.
inline Tensor aligned(const Tensor& t, int words) {
  const Tensor out = packed(t);
  const bool fits = reinterpret_cast<uintptr_t>(out.const_data_ptr()) % (4 * words) == 0;
  return heard([&] { return fits ? out : torch::stable::clone(out); });
}

// Returns `t` contiguous, with the dtype and on the device of `like`.
inline Tensor converted(const Tensor& t, const Tensor& like) {
  if (alike(t, like)) return packed(t);
  return heard([&] { return packed(torch::stable::to(t, like.scalar_type(), std::nullopt, like.device())); });
}

}  // namespace gs
