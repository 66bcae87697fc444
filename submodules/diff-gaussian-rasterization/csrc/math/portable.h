#pragma once
// Elementary functions from operations that IEEE 754 rounds in one way only: a GPU and every CPU give the same bits.
// For sources that are compiled once (gs/rounded.h). Those of float are for what each step computes: most GPUs compute
// in double 32 or 64 times as slowly.
#include <cmath>
#include <cstdint>
#include <cstring>

#include "gs/rounded.h"

namespace gs {
namespace portable {

constexpr double kLn2High = 0x1.62e42feep-1;  // 21 trailing zero bits: its product with every exponent is exact
constexpr double kLn2Low = 0x1.a39ef35793c76p-33;
constexpr double kHalfPi = 1.5707963267948966;

// A polynomial by its coefficients, highest power first.
template <class T, int N>
GS_HD T polynomial(T x, const T (&coefficients)[N]) {
  T result = coefficients[0];
  for (int k = 1; k < N; ++k) result = rounded_product(result, x) + coefficients[k];
  return result;
}

// e^x to a few units in the last place; |x| is cut to 700. NaN stays.
GS_HD double exp(double x) {
  if (!(x == x)) return x;
  x = x < -700 ? -700 : x > 700 ? 700 : x;
  const double exponent = std::rint(x * 1.4426950408889634);
  const double r = (x - rounded_product(exponent, kLn2High)) - rounded_product(exponent, kLn2Low);
  // |r| <= 0.347: what is left out of the Taylor series is below 4e-18.
  const double coefficients[] = {
      1 / 6227020800.0, 1 / 479001600.0, 1 / 39916800.0, 1 / 3628800.0, 1 / 362880.0, 1 / 40320.0, 1 / 5040.0,
      1 / 720.0,        1 / 120.0,       1 / 24.0,       1 / 6.0,       1 / 2.0,      1,           1};
  const int64_t bits = (int64_t(exponent) + 1023) << 52;
  double power;
  std::memcpy(&power, &bits, sizeof power);
  return polynomial(r, coefficients) * power;
}

// e^x to 2e-7 of the result, infinite from 88 on, 0 below -87. NaN stays.
GS_HD float exp(float x) {
  if (!(x <= 88 && x >= -87)) return x > 88 ? INFINITY : x < -87 ? 0 : x;
  const float exponent = std::rint(x * 1.44269504f);
  // The first product is exact. |r| <= 0.347: what is left out of the Taylor series is below 6e-9.
  const float r = (x - rounded_product(exponent, 0.693359375f)) - rounded_product(exponent, -2.12194440e-4f);
  const float coefficients[] = {1 / 5040.0f, 1 / 720.0f, 1 / 120.0f, 1 / 24.0f, 1 / 6.0f, 1 / 2.0f, 1, 1};
  const int32_t bits = (int32_t(exponent) + 127) << 23;
  float power;
  std::memcpy(&power, &bits, sizeof power);
  return polynomial(r, coefficients) * power;
}

// The natural logarithm of a positive finite number, to 1e-15 relative to max(1, |result|).
GS_HD double log(double x) {
  int whole;
  double mantissa = std::frexp(x, &whole);
  if (mantissa < 0.7071067811865476) mantissa *= 2, --whole;
  const double exponent = whole;
  const double z = (mantissa - 1) / (mantissa + 1);  // log m = 2 atanh z, |z| <= 0.1716: z^23 / 23 is below 1e-18
  const double coefficients[] = {2 / 21.0, 2 / 19.0, 2 / 17.0, 2 / 15.0, 2 / 13.0, 2 / 11.0,
                                 2 / 9.0,  2 / 7.0,  2 / 5.0,  2 / 3.0,  2};
  const double series = rounded_product(z, polynomial(z * z, coefficients));
  return rounded_product(exponent, kLn2High) + (rounded_product(exponent, kLn2Low) + series);
}

// The same of a normal float, to 2e-7.
GS_HD float log(float x) {
  int32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  int32_t whole = (bits >> 23) - 126;
  bits = (bits & 0x7fffff) | 126 << 23;
  float mantissa;
  std::memcpy(&mantissa, &bits, sizeof mantissa);
  if (mantissa < 0.70710678f) mantissa *= 2, --whole;
  const float exponent = float(whole);
  const float z = (mantissa - 1) / (mantissa + 1);  // z^11 / 11 is below 4e-10
  const float coefficients[] = {2 / 9.0f, 2 / 7.0f, 2 / 5.0f, 2 / 3.0f, 2};
  const float series = rounded_product(z, polynomial(z * z, coefficients));
  return rounded_product(exponent, 0.693359375f) + (rounded_product(exponent, -2.12194440e-4f) + series);
}

template <class T>
struct CosSin {
  T cos, sin;

  // Of an angle of the first quadrant, turned by as many quadrants as the upper two bits say.
  GS_HD CosSin turned(uint32_t turns) const {
    const CosSin once = turns & 0x40000000u ? CosSin{-sin, cos} : *this;
    return turns & 0x80000000u ? CosSin{-once.cos, -once.sin} : once;
  }
};

// cos and sin of 2 pi * turns / 2^32, with an absolute error of 1e-16.
GS_HD void cos_sin_turns(uint32_t turns, CosSin<double>& out) {
  const double angle = double(turns & 0x3fffffffu) * (kHalfPi * 0x1p-30);
  const double square = angle * angle;  // angle < pi / 2: the first terms left out are below 1e-18
  const double of_cos[] = {-1 / 1124000727777607680000.0,
                           1 / 2432902008176640000.0,
                           -1 / 6402373705728000.0,
                           1 / 20922789888000.0,
                           -1 / 87178291200.0,
                           1 / 479001600.0,
                           -1 / 3628800.0,
                           1 / 40320.0,
                           -1 / 720.0,
                           1 / 24.0,
                           -1 / 2.0,
                           1};
  // 23! is no double; its inverse is rounded once.
  const double of_sin[] = {-3.868170170630684e-23,
                           1 / 51090942171709440000.0,
                           -1 / 121645100408832000.0,
                           1 / 355687428096000.0,
                           -1 / 1307674368000.0,
                           1 / 6227020800.0,
                           -1 / 39916800.0,
                           1 / 362880.0,
                           -1 / 5040.0,
                           1 / 120.0,
                           -1 / 6.0,
                           1};
  out = CosSin<double>{polynomial(square, of_cos), angle * polynomial(square, of_sin)}.turned(turns);
}

// The same with an absolute error of 2.5e-7.
GS_HD void cos_sin_turns(uint32_t turns, CosSin<float>& out) {
  const float angle = float(turns & 0x3fffffffu) * float(kHalfPi * 0x1p-30);
  const float square = angle * angle;  // the first terms left out are below 6e-9
  const float of_cos[] = {1 / 479001600.0f, -1 / 3628800.0f, 1 / 40320.0f, -1 / 720.0f, 1 / 24.0f, -1 / 2.0f, 1};
  const float of_sin[] = {1 / 6227020800.0f, -1 / 39916800.0f, 1 / 362880.0f, -1 / 5040.0f, 1 / 120.0f, -1 / 6.0f, 1};
  out = CosSin<float>{polynomial(square, of_cos), angle * polynomial(square, of_sin)}.turned(turns);
}

}  // namespace portable
}  // namespace gs
