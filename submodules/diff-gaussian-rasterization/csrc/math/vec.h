#pragma once
// Vectors of three, and scalar helpers.
#include <cmath>

#include "gs/fused_lanes.h"
#include "gs/hd.h"
#include "gs/isa.h"

GS_ISA_BEGIN

template <class T>
struct Vec3 {
  T x, y, z;
};

template <class T>
GS_HD Vec3<T> operator+(Vec3<T> a, Vec3<T> b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class T>
GS_HD Vec3<T> operator-(Vec3<T> a, Vec3<T> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class T>
GS_HD Vec3<T> operator*(T s, Vec3<T> a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class T>
GS_HD T dot(Vec3<T> a, Vec3<T> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class T>
GS_HD Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
GS_HD bool finite(Vec3<T> a) {
  return std::isfinite(a.x) & std::isfinite(a.y) &
         std::isfinite(a.z);  // & instead of &&: no load waits for another's test
}
template <class T>
GS_HD T clamp(T value, T low, T high) {
  return value < low ? low : value > high ? high : value;
}
// a b + c, rounded in one way wherever it is compiled: counting and emission must not differ by what a compiler fuses,
// nor forward and backward. T may be a vector.
template <class T>
GS_HD T multiply_add(T a, T b, T c) {
#if defined(__CUDA_ARCH__)
  return std::fma(a, b, c);
#elif defined(__FMA__)
  if constexpr (std::is_floating_point_v<T>)
    return std::fma(a, b, c);
  else
    return fused_lanes(a, b, c);
#else
  return a * b + c;  // nothing to fuse it with
#endif
}
template <class T>
GS_HD T larger(T a, T b) {
  return a < b ? b : a;
}
template <class T>
GS_HD Vec3<T> load3(const T* p) {
  return {p[0], p[1], p[2]};
}
template <class T>
GS_HD void store3(T* p, Vec3<T> v) {
  p[0] = v.x, p[1] = v.y, p[2] = v.z;
}

// Length without overflow or underflow of the squares.
template <class T>
GS_HD T length(Vec3<T> a) {
  const T m = larger(larger(std::abs(a.x), std::abs(a.y)), std::abs(a.z));
  if (!(m > 0)) return m;
  const T x = a.x / m, y = a.y / m, z = a.z / m;
  return m * std::sqrt(x * x + y * y + z * z);
}
template <class T>
GS_HD T length(T x, T y) {
  const T m = larger(std::abs(x), std::abs(y));
  if (!(m > 0)) return m;
  const T a = x / m, b = y / m;
  return m * std::sqrt(a * a + b * b);
}

GS_ISA_END
