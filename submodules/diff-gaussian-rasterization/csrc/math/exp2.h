#pragma once
// 2^t, for vectors of a CPU and for a GPU.
#include <cmath>
#include <cstring>

#include "gs/isa.h"

GS_ISA_BEGIN

// 2^t on lanes, |t| < 120. t = n + f, |f| <= 1/2: adding 1.5 * 2^mantissa rounds to n and leaves n in the low bits.
// Integer addition puts those onto the exponent of 2^f. 2^f is a polynomial: in float the minimax one of degree 6
// (relative error 1.9e-9, below rounding), in double Taylor's of degree 13 (4e-18).
template <class V, class I>
inline V exp2_lanes(V t, float) {
  const float magic = 12582912.0f;
  const V shifted = t + magic;
  const V f = t - (shifted - magic);
  V p = f * 0.000153458121587f + 0.00133999312095f;
  p = p * f + 0.00961848895652f;
  p = p * f + 0.05550328777f;
  p = p * f + 0.240226468906f;
  p = p * f + 0.693147205737f;
  p = p * f + 1.00000000055f;
  I bits, n;
  std::memcpy(&bits, &p, sizeof bits);
  std::memcpy(&n, &shifted, sizeof n);
  bits += n << 23;
  std::memcpy(&p, &bits, sizeof p);
  return p;
}

template <class V, class I>
inline V exp2_lanes(V t, double) {
  const double magic = 6755399441055744.0;
  const V shifted = t + magic;
  const V f = (t - (shifted - magic)) * 0.693147180559945309417;
  V p = f * (1.0 / 6227020800) + 1.0 / 479001600;
  const double inverse_factorial[] = {1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320, 1.0 / 5040, 1.0 / 720,
                                      1.0 / 120,      1.0 / 24,      1.0 / 6,      1.0 / 2,     1.0,        1.0};
  for (double c : inverse_factorial) p = p * f + c;
  I bits, n;
  std::memcpy(&bits, &p, sizeof bits);
  std::memcpy(&n, &shifted, sizeof n);
  bits += n << 52;
  std::memcpy(&p, &bits, sizeof p);
  return p;
}

// 2^t by the GPU's own instruction, accurate to 2 units in the last place. Results below the normal range are 0.
#ifdef __CUDACC__
__device__ __forceinline__ float exp2_device(float t) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(t));
  return y;
}
#else  // where the CPU emulates a GPU
inline float exp2_device(float t) { return std::exp2(t); }
#endif

GS_ISA_END
