#pragma once
// Vectors of three, and helpers for numbers.
#include "gs/fused_lanes.h"
#include "gs/number.h"

GS_ISA_BEGIN

template <class T>
struct Vec3 {
  T x, y, z;
};

// A and B: the same, or a vector type and its scalar.
template <class A, class B>
GS_HD auto operator+(Vec3<A> a, Vec3<B> b) -> Vec3<decltype(a.x + b.x)> {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class A, class B>
GS_HD auto operator-(Vec3<A> a, Vec3<B> b) -> Vec3<decltype(a.x - b.x)> {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class A, class B>
GS_HD auto operator*(A s, Vec3<B> a) -> Vec3<decltype(s * a.x)> {
  return {s * a.x, s * a.y, s * a.z};
}
template <class A, class B>
GS_HD auto dot(Vec3<A> a, Vec3<B> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class T>
GS_HD Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
GS_HD Truth<T> finite(Vec3<T> a) {
  return is_finite(a.x) & is_finite(a.y) & is_finite(a.z);  // & instead of &&: no load waits for another's test
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
#elif defined(GS_FUSES)
  if constexpr (std::is_floating_point_v<T>)
    return std::fma(a, b, c);
  else
    return fused_lanes(a, b, c);
#else
  return a * b + c;  // nothing to fuse it with
#endif
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
  const T m = larger(larger(magnitude(a.x), magnitude(a.y)), magnitude(a.z));
  const T x = a.x / m, y = a.y / m, z = a.z / m;
  return m > 0 ? m * root(x * x + y * y + z * z) : m;
}
template <class T>
GS_HD T length(T x, T y) {
  const T m = larger(magnitude(x), magnitude(y));
  const T a = x / m, b = y / m;
  return m > 0 ? m * root(a * a + b * b) : m;
}

GS_ISA_END
