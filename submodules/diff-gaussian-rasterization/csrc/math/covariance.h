#pragma once
// A Gaussian's shape as three axes: its 3D covariance is the sum of axis axis^T, axis_k = scale_k * column k of R.
#include "../data.h"
#include "activation.h"
#include "vec.h"

GS_ISA_BEGIN

template <class T>
struct Axes {
  Vec3<T> direction[3];  // columns of R; unit vectors for a unit quaternion
  T scale[3];
  Dilation<Scalar<T>> dilation;
};

// Columns of R(q). As in the reference, q is used as it is: for |q| != 1 the result is no rotation.
template <class T>
GS_HD void rotation_columns(Quat<T> q, Vec3<T> column[3]) {
  column[0] = {1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y)};
  column[1] = {2 * (q.x * q.y - q.w * q.z), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z + q.w * q.x)};
  column[2] = {2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y)};
}

// The gradient of q from those of the columns, entry by entry of the above.
template <class T>
GS_HD Quat<T> rotation_columns_vjp(Quat<T> q, const Vec3<T> g[3]) {
  return {
      2 * (q.z * (g[0].y - g[1].x) + q.y * (g[2].x - g[0].z) + q.x * (g[1].z - g[2].y)),
      2 * (q.y * (g[0].y + g[1].x) + q.z * (g[0].z + g[2].x) + q.w * (g[1].z - g[2].y)) - 4 * q.x * (g[1].y + g[2].z),
      2 * (q.x * (g[0].y + g[1].x) + q.z * (g[1].z + g[2].y) + q.w * (g[2].x - g[0].z)) - 4 * q.y * (g[0].x + g[2].z),
      2 * (q.x * (g[0].z + g[2].x) + q.y * (g[1].z + g[2].y) + q.w * (g[0].y - g[1].x)) - 4 * q.z * (g[0].x + g[1].y)};
}

// Axes of a given covariance (xx, xy, xz, yy, yz, zz) by Cholesky. A pivot that rounding made negative counts as zero.
template <class T>
GS_HD Axes<T> axes_of_covariance(const T* c) {
  const T zero = {}, one = all<T>(1);
  const T a = root(larger(c[0], zero));
  const T b = a > 0 ? c[1] / a : zero, d = a > 0 ? c[2] / a : zero;
  const T e = root(larger(c[3] - b * b, zero));
  const T f = e > 0 ? (c[4] - b * d) / e : zero;
  const T g = root(larger(c[5] - d * d - f * f, zero));
  return {{{a, b, d}, {zero, e, f}, {zero, zero, g}}, {one, one, one}, {}};
}

GS_ISA_END
