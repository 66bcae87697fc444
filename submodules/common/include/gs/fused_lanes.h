#pragma once
// The fused a b + c of vectors, as an instruction: from an expression a compiler may hoist the product out of a loop.
#include <type_traits>

#include "gs/isa.h"

#if defined(GS_FUSES) && !defined(__CUDACC__)
#ifdef GS_NEON
#include <arm_neon.h>
#else
#include <immintrin.h>
#endif

GS_ISA_BEGIN

template <class V>
inline V fused_lanes(V a, V b, V c) {
  constexpr bool kFloat = std::is_same_v<std::decay_t<decltype(a[0])>, float>;
#ifdef GS_NEON
  if constexpr (kFloat) return (V)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
  if constexpr (!kFloat) return (V)vfmaq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b);
#else
#ifdef __AVX512F__
  if constexpr (sizeof(V) == 64 && kFloat) return (V)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
  if constexpr (sizeof(V) == 64 && !kFloat) return (V)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c);
#endif
  if constexpr (sizeof(V) == 32 && kFloat) return (V)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
  if constexpr (sizeof(V) == 32 && !kFloat) return (V)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c);
#endif
}

GS_ISA_END
#endif
