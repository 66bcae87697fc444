#pragma once
// Vectors of N lanes by the compilers' vector extension (GCC, Clang): operators and ?: work lane by lane.
#include <cstdint>
#include <cstring>

#include "gs/isa.h"

GS_ISA_BEGIN

template <class T>
struct IntOf;
template <>
struct IntOf<float> {
  using type = int32_t;
};
template <>
struct IntOf<double> {
  using type = int64_t;
};

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64;
#elif defined(__AVX__)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

template <class T>
struct Simd {
  static constexpr int kLanes = kVectorBytes / sizeof(T);
  using Int = typename IntOf<T>::type;
  typedef T Vec __attribute__((vector_size(kVectorBytes)));
  typedef Int Mask __attribute__((vector_size(kVectorBytes)));  // each lane 0 or -1

  static Vec load(const T* from) {
    Vec v;
    std::memcpy(&v, from, sizeof v);
    return v;
  }
  static void store(T* to, Vec v) { std::memcpy(to, &v, sizeof v); }
  static Vec all(T value) { return value - Vec{}; }

  static bool any(Mask m) {
    typedef int64_t Words __attribute__((vector_size(kVectorBytes)));
    Words w;
    std::memcpy(&w, &m, sizeof w);
    int64_t bits = 0;
    for (int i = 0; i < kVectorBytes / 8; ++i) bits |= w[i];
    return bits != 0;
  }

  // Sum of the lanes by halves: one fixed tree for an instruction set.
  static T sum(Vec v) {
    T lanes[kLanes];
    store(lanes, v);
    for (int half = kLanes / 2; half > 0; half /= 2)
      for (int i = 0; i < half; ++i) lanes[i] += lanes[i + half];
    return lanes[0];
  }
};

GS_ISA_END
