#pragma once
// Vectors by the vector extension of GCC and Clang: operators and ?: work lane by lane.
#include <cmath>
#include <cstdint>
#include <cstring>

#include "gs/isa.h"

#ifdef __SSE2__
#include <immintrin.h>
#endif

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

  // The root of each lane, rounded correctly.
  static Vec root(Vec v) {
#if defined(__AVX512F__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm512_sqrt_ps((__m512)v);
    return (Vec)_mm512_sqrt_pd((__m512d)v);
#elif defined(__AVX__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm256_sqrt_ps((__m256)v);
    return (Vec)_mm256_sqrt_pd((__m256d)v);
#elif defined(__SSE2__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm_sqrt_ps((__m128)v);
    return (Vec)_mm_sqrt_pd((__m128d)v);
#else
    for (int i = 0; i < kLanes; ++i) v[i] = std::sqrt(v[i]);
    return v;
#endif
  }

  // a b + c, fused wherever the instruction set can: a compiler would choose which of two products it fuses.
  static Vec multiply_add(Vec a, Vec b, Vec c) {
#if defined(__AVX512F__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
    return (Vec)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c);
#elif defined(__FMA__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
    return (Vec)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c);
#else
    return a * b + c;
#endif
  }

  static bool any(Mask m) {
#if defined(__AVX512F__)
    return _mm512_test_epi64_mask((__m512i)m, (__m512i)m) != 0;
#elif defined(__AVX__)
    return !_mm256_testz_si256((__m256i)m, (__m256i)m);
#elif defined(__SSE2__)
    return _mm_movemask_epi8((__m128i)m) != 0;
#else
    bool found = false;
    for (int i = 0; i < kLanes; ++i) found |= m[i] != 0;
    return found;
#endif
  }

  // A bit for each lane.
  static uint32_t bits(Mask m) {
#if defined(__AVX512DQ__)
    if constexpr (sizeof(T) == 4) return _mm512_movepi32_mask((__m512i)m);
    return _mm512_movepi64_mask((__m512i)m);
#elif defined(__AVX__)
    if constexpr (sizeof(T) == 4) return uint32_t(_mm256_movemask_ps((__m256)m));
    return uint32_t(_mm256_movemask_pd((__m256d)m));
#else
    uint32_t found = 0;
    for (int i = 0; i < kLanes; ++i) found |= uint32_t(m[i] != 0) << i;
    return found;
#endif
  }

  // Sums the lanes by halves: one fixed tree for an instruction set.
  static T sum(Vec v) { return halves<kLanes>(v); }

 private:
  template <int kCount, class Part>
  static T halves(Part v) {
    if constexpr (kCount == 1) {
      return v[0];
    } else {
      typedef T Half __attribute__((vector_size(kCount / 2 * sizeof(T))));
      Half low, high;
      std::memcpy(&low, &v, sizeof low);
      std::memcpy(&high, reinterpret_cast<const char*>(&v) + sizeof low, sizeof high);
      return halves<kCount / 2>(Half(low + high));
    }
  }
};

GS_ISA_END
