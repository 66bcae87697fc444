#pragma once
// Exponential and logarithms of numbers. On a CPU, floats have polynomials: alone or in a vector they give the same
// bits, whatever the library. Doubles take the library's functions, and so does a GPU.
#include <cmath>
#include <cstring>

#include "vec.h"

GS_ISA_BEGIN

#ifndef __CUDACC__
template <class V>
constexpr bool kIsFloat = std::is_same_v<Scalar<V>, float>;

template <class V, class Function>
V by_lane(V x, const Function& function) {
  for (int i = 0; i < LanesOf<V>::kLanes; ++i) x[i] = function(x[i]);
  return x;
}

// 2^n for whole numbers -126 <= n <= 127.
template <class V>
V power_of_two(Integer<V> n) {
  const Integer<V> bits = (n + 127) << 23;
  V power;
  std::memcpy(&power, &bits, sizeof power);
  return power;
}

// e^x = 2^n e^r, |r| <= ln2 / 2. n ln2 is taken off in two parts, the first of which has 9 bits, so that its product is
// exact. Of e^r, a polynomial with a relative error of 3e-9. 2^n comes as two factors, because values below float's
// normal range still count.
template <class V>
V float_exponential(V x) {
  const V least = all<V>(-104), most = all<V>(89);  // beyond, 0 and infinity
  x = x < least ? least : x > most ? most : x;
  const float magic = 12582912.0f;  // added, it rounds to a whole number
  const V n = (x * 1.44269504088896341f + magic) - magic;
  const V r = (x - n * 0.693359375f) + n * 2.12194440054690583e-4f;
  V p = r * 0.0013950725960012768f + 0.008369024852321777f;
  p = p * r + 0.04166620228440471f;
  p = p * r + 0.16666517711554327f;
  p = p * r + 0.500000009627672f;
  p = p * (r * r) + r + 1.0f;
  const V known = x == x ? n : V{};  // no integer holds what is not a number
  const Integer<V> whole = integer(known), half = whole >> 1;
  return p * power_of_two<V>(half) * power_of_two<V>(whole - half);
}

// ln(1 + x) for 0 <= x <= 1. Large x are taken as 1 + x = 2 (1 + z). With s = z / (2 + z), ln(1 + z) is 2 s plus a
// series in odd powers of s, here a polynomial with a relative error of 1e-9; 2 s = z - s z keeps the quotient's
// rounding small.
template <class V>
V float_log_one_plus(V x) {
  const Truth<V> large = x > 0.41421356f;
  const V z = large ? (x - 1) * 0.5f : x;
  const V s = z / (2 + z), square = s * s;
  const V series = ((square * 0.29875572334660394f + 0.39977410027120663f) * square + 0.6666677734184757f) * square;
  const V log = z - s * (z - series);
  return large ? log + 0.693147180559945309f : log;
}
#endif

template <class V>
GS_HD V exponential(V x) {
#ifndef __CUDACC__
  if constexpr (kIsFloat<V>) return float_exponential(x);
#endif
  GS_BY_LANES(std::exp(x), by_lane(x, [](Scalar<V> lane) { return std::exp(lane); }))
}

// ln(1 + x) for 0 <= x <= 1.
template <class V>
GS_HD V log_one_plus(V x) {
#ifndef __CUDACC__
  if constexpr (kIsFloat<V>) return float_log_one_plus(x);
#endif
  GS_BY_LANES(std::log1p(x), by_lane(x, [](Scalar<V> lane) { return std::log1p(lane); }))
}

template <class V>
GS_HD V binary_log(V x){GS_BY_LANES(std::log2(x), by_lane(x, [](Scalar<V> lane) { return std::log2(lane); }))}

GS_ISA_END
