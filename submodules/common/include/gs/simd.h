#pragma once
// Vectors by the vector extension of GCC and Clang: operators and ?: work lane by lane.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "gs/fused_lanes.h"
#include "gs/isa.h"

#if defined(GS_NEON)
#include <arm_neon.h>
#elif defined(__SSE2__)
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

template <class T, int kBytes = kVectorBytes>
struct Simd {
  static constexpr int kLanes = kBytes / sizeof(T);
  using Int = typename IntOf<T>::type;
  typedef T Vec __attribute__((vector_size(kBytes)));
  typedef Int Mask __attribute__((vector_size(kBytes)));  // each lane 0 or -1

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
    if constexpr (sizeof(T) == 4) return (Vec)_mm512_maskz_sqrt_ps(-1, (__m512)v);
    return (Vec)_mm512_maskz_sqrt_pd(-1, (__m512d)v);
#elif defined(__AVX__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm256_sqrt_ps((__m256)v);
    return (Vec)_mm256_sqrt_pd((__m256d)v);
#elif defined(__SSE2__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm_sqrt_ps((__m128)v);
    return (Vec)_mm_sqrt_pd((__m128d)v);
#elif defined(GS_NEON)
    if constexpr (sizeof(T) == 4) return (Vec)vsqrtq_f32((float32x4_t)v);
    return (Vec)vsqrtq_f64((float64x2_t)v);
#else
    for (int i = 0; i < kLanes; ++i) v[i] = std::sqrt(v[i]);
    return v;
#endif
  }

  static Vec magnitude(Vec v) { return (Vec)((Mask)v & std::numeric_limits<Int>::max()); }

  // The least whole number that is not below it, of each lane.
  static Vec rounded_up(Vec v) {
#if defined(__AVX512F__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm512_ceil_ps((__m512)v);
    return (Vec)_mm512_ceil_pd((__m512d)v);
#elif defined(__AVX__)
    if constexpr (sizeof(T) == 4) return (Vec)_mm256_ceil_ps((__m256)v);
    return (Vec)_mm256_ceil_pd((__m256d)v);
#elif defined(GS_NEON)
    if constexpr (sizeof(T) == 4) return (Vec)vrndpq_f32((float32x4_t)v);
    return (Vec)vrndpq_f64((float64x2_t)v);
#else
    for (int i = 0; i < kLanes; ++i) v[i] = std::ceil(v[i]);
    return v;
#endif
  }

  // a b + c, fused wherever the instruction set can: a compiler would choose which of two products it fuses.
  static Vec multiply_add(Vec a, Vec b, Vec c) {
#ifdef GS_FUSES
    return fused_lanes(a, b, c);
#else
    return a * b + c;
#endif
  }

  static bool any(Mask m) {
#if defined(__AVX512F__)
    if constexpr (kBytes == 64) return _mm512_test_epi64_mask((__m512i)m, (__m512i)m) != 0;
#endif
#if defined(__AVX__)
    if constexpr (kBytes == 32) return !_mm256_testz_si256((__m256i)m, (__m256i)m);
#endif
#if defined(__SSE2__)
    if constexpr (kBytes == 16) return _mm_movemask_epi8((__m128i)m) != 0;
#elif defined(GS_NEON)
    if constexpr (kBytes == 16) return vmaxvq_u32((uint32x4_t)m) != 0;
#endif
    return bits(m) != 0;
  }

  // A bit for each lane.
  static uint32_t bits(Mask m) {
#if defined(__AVX512DQ__)
    if constexpr (kBytes == 64 && sizeof(T) == 4) return _mm512_movepi32_mask((__m512i)m);
    if constexpr (kBytes == 64 && sizeof(T) == 8) return _mm512_movepi64_mask((__m512i)m);
#endif
#if defined(__AVX__)
    if constexpr (kBytes == 32 && sizeof(T) == 4) return uint32_t(_mm256_movemask_ps((__m256)m));
    if constexpr (kBytes == 32 && sizeof(T) == 8) return uint32_t(_mm256_movemask_pd((__m256d)m));
#endif
#if defined(__SSE2__)
    if constexpr (kBytes == 16 && sizeof(T) == 4) return uint32_t(_mm_movemask_ps((__m128)m));
    if constexpr (kBytes == 16 && sizeof(T) == 8) return uint32_t(_mm_movemask_pd((__m128d)m));
#elif defined(GS_NEON)
    if constexpr (kBytes == 16 && sizeof(T) == 4) return vaddvq_u32((uint32x4_t)m & uint32x4_t{1, 2, 4, 8});
    if constexpr (kBytes == 16 && sizeof(T) == 8) return uint32_t(vaddvq_u64((uint64x2_t)m & uint64x2_t{1, 2}));
#endif
    uint32_t found = 0;
    for (int i = 0; i < kLanes; ++i) found |= uint32_t(m[i] != 0) << i;
    return found;
  }
};

GS_ISA_END
