#pragma once
// Replaces the functions of CUB that the kernels use: same results, and the first call gives the size of the memory.
#include <algorithm>
#include <cstdint>
#include <numeric>
#include <vector>

#include "../cuda_runtime.h"

namespace cub {

template <class T>
struct DoubleBuffer {
  T* buffers[2];
  int selector = 0;
  DoubleBuffer(T* current, T* alternate) : buffers{current, alternate} {}
  T* Current() { return buffers[selector]; }
  T* Alternate() { return buffers[selector ^ 1]; }
};

struct DeviceRadixSort {
  template <class Key, class Value, class Count>
  static cudaError_t SortPairs(void* memory, size_t& bytes, DoubleBuffer<Key>& keys, DoubleBuffer<Value>& values,
                               Count n, int begin_bit, int end_bit, cudaStream_t) {
    if (!memory) return bytes = 1, cudaSuccess;
    std::vector<int64_t> order(n);
    std::iota(order.begin(), order.end(), int64_t(0));
    const uint64_t mask = end_bit - begin_bit == 64 ? ~uint64_t(0) : (uint64_t(1) << (end_bit - begin_bit)) - 1;
    const auto part = [&](int64_t i) { return uint64_t(keys.Current()[i]) >> begin_bit & mask; };
    std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return part(a) < part(b); });
    for (int64_t i = 0; i < int64_t(n); ++i)
      keys.Alternate()[i] = keys.Current()[order[i]], values.Alternate()[i] = values.Current()[order[i]];
    if ((end_bit - begin_bit + 7) / 8 % 2)  // the passes of a GPU, each of which changes sides
      keys.selector ^= 1, values.selector ^= 1;
    else
      std::copy_n(keys.Alternate(), n, keys.Current()), std::copy_n(values.Alternate(), n, values.Current());
    return cudaSuccess;
  }

  template <class Key, class Value, class Count>
  static cudaError_t SortPairs(void* memory, size_t& bytes, const Key* keys, Key* sorted, const Value* values,
                               Value* sorted_values, Count n, int begin_bit, int end_bit, cudaStream_t stream) {
    if (!memory) return bytes = 1, cudaSuccess;
    std::vector<Key> own_keys(keys, keys + n);
    std::vector<Value> own_values(values, values + n);
    DoubleBuffer<Key> of_keys(own_keys.data(), sorted);
    DoubleBuffer<Value> of_values(own_values.data(), sorted_values);
    SortPairs(memory, bytes, of_keys, of_values, n, begin_bit, end_bit, stream);
    if (of_keys.Current() != sorted) std::copy_n(of_keys.Current(), n, sorted);
    if (of_values.Current() != sorted_values) std::copy_n(of_values.Current(), n, sorted_values);
    return cudaSuccess;
  }
};

struct DeviceScan {
  template <class In, class Out, class Count>
  static cudaError_t ExclusiveSum(void* memory, size_t& bytes, In in, Out out, Count n, cudaStream_t) {
    if (!memory) return bytes = 1, cudaSuccess;
    std::decay_t<decltype(in[0])> sum = 0;
    for (Count i = 0; i < n; ++i) {
      const auto value = in[i];
      out[i] = sum;
      sum += value;
    }
    return cudaSuccess;
  }
};

struct DeviceReduce {
  template <class In, class Out, class Count>
  static cudaError_t Sum(void* memory, size_t& bytes, In in, Out* out, Count n, cudaStream_t) {
    if (!memory) return bytes = 1, cudaSuccess;
    *out = 0;
    for (Count i = 0; i < n; ++i) *out += Out(in[i]);
    return cudaSuccess;
  }
};

struct DeviceSelect {
  template <class In, class Out, class Number, class Count, class Predicate>
  static cudaError_t If(void* memory, size_t& bytes, In in, Out* out, Number* selected, Count n,
                        const Predicate& wanted, cudaStream_t) {
    if (!memory) return bytes = 1, cudaSuccess;
    *selected = 0;
    for (Count i = 0; i < n; ++i)
      if (wanted(in[i])) out[(*selected)++] = in[i];
    return cudaSuccess;
  }
};

}  // namespace cub
