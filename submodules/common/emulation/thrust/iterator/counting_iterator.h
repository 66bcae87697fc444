#pragma once
#include <cstdint>

namespace thrust {
template <class T>
struct counting_iterator {
  T first;
  explicit counting_iterator(T value) : first(value) {}
  T operator[](int64_t i) const { return T(first + i); }
};
}  // namespace thrust
