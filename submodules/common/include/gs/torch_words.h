#pragma once
// Errors of operators, and words for their messages. For csrc/torch alone.
#include <torch/csrc/stable/tensor.h>

#include <sstream>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

// In torch from 2.13 on.
extern "C" __attribute__((weak)) const char* torch_exception_get_what_without_backtrace();

namespace gs {

using torch::headeronly::ScalarType;
using torch::stable::Device, torch::stable::Tensor;
using Sizes = torch::headeronly::IntHeaderOnlyArrayRef;

// Shapes, dtypes and devices as Python writes them.
inline std::string in_words(Sizes sizes) {
  std::string words;
  for (int64_t size : sizes) words += (words.empty() ? "" : ", ") + std::to_string(size);
  return "(" + words + (sizes.size() == 1 ? ",)" : ")");
}

inline std::string in_words(ScalarType type) {
  static const std::pair<ScalarType, const char*> names[] = {
      {ScalarType::Float, "float32"},    {ScalarType::Double, "float64"}, {ScalarType::Half, "float16"},
      {ScalarType::Byte, "uint8"},       {ScalarType::Char, "int8"},      {ScalarType::Short, "int16"},
      {ScalarType::Int, "int32"},        {ScalarType::Long, "int64"},     {ScalarType::Bool, "bool"},
      {ScalarType::BFloat16, "bfloat16"}};
  for (const auto& [named, name] : names)
    if (named == type) return std::string("torch.") + name;
  return torch::headeronly::toString(type);
}

inline std::string in_words(Device device) {
  const std::string index = device.has_index() ? ":" + std::to_string(device.index()) : "";
  return (device.is_cuda() ? "cuda" : device.is_cpu() ? "cpu" : "another device") + index;
}

// All three of a tensor.
inline std::string in_words(const Tensor& t) {
  return in_words(t.sizes()) + " " + in_words(t.scalar_type()) + " on " + in_words(t.device());
}

template <class Part>
decltype(auto) written(const Part& part) {
  constexpr bool is_sizes = std::is_same_v<Part, Sizes> || std::is_same_v<Part, std::vector<int64_t>>;
  if constexpr (is_sizes || std::is_same_v<Part, ScalarType> || std::is_same_v<Part, Device>)
    return in_words(part);
  else
    return (part);
}

template <class... Parts>
std::string joined(const Parts&... parts) {
  std::ostringstream words;
  (words << ... << written(parts));
  return words.str();
}

}  // namespace gs

// Errors of operators. torch's stable interface makes a RuntimeError of every exception, so the message of another
// error begins with its type, which operators.py of the package raises in its place.
#define GS_CHECK(condition, ...)                                           \
  do {                                                                     \
    if (!(condition)) throw std::runtime_error(::gs::joined(__VA_ARGS__)); \
  } while (0)
#define GS_CHECK_TYPE(condition, ...) GS_CHECK(condition, "TypeError: ", __VA_ARGS__)
#define GS_CHECK_VALUE(condition, ...) GS_CHECK(condition, "ValueError: ", __VA_ARGS__)

namespace gs {

// Raises what a failed call of torch has said, of which torch's interface hands on the failure alone. Before torch 2.13
// it is on stderr, and the caller's own words stand for it.
[[noreturn]] inline void raise_said(const std::string& otherwise) {
  const bool known = torch_exception_get_what_without_backtrace;
  const std::string said = known ? torch_exception_get_what_without_backtrace() : otherwise;
  const bool memory = said.find("out of memory") != said.npos || said.find("allocate memory") != said.npos;
  throw std::runtime_error((memory ? "OutOfMemoryError: " : "") + said);
}

// The result of a function that calls torch.
template <class Function>
auto heard(const Function& function) {
  try {
    return function();
  } catch (const std::runtime_error& error) {
    raise_said(error.what());
  }
}

}  // namespace gs
