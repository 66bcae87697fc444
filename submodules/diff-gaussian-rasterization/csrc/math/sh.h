#pragma once
// Real spherical harmonics to degree 3, in the order and with the signs of the reference's PLY files.
#include "vec.h"

GS_ISA_BEGIN

constexpr int kMaxShDegree = 3;

GS_HD constexpr int sh_count(int degree) { return (degree + 1) * (degree + 1); }

// Computes basis[k], k < sh_count(degree), at the unit vector d.
template <class T>
GS_HD void sh_basis(int degree, Vec3<T> d, T* basis) {
  basis[0] = all<T>(0.28209479177387814);
  if (degree < 1) return;
  const T x = d.x, y = d.y, z = d.z;
  const Scalar<T> c1 = Scalar<T>(0.4886025119029199);
  basis[1] = -c1 * y, basis[2] = c1 * z, basis[3] = -c1 * x;
  if (degree < 2) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  const Scalar<T> c2 = Scalar<T>(1.0925484305920792);
  basis[4] = c2 * x * y, basis[5] = -c2 * y * z;
  basis[6] = Scalar<T>(0.31539156525252005) * (2 * zz - xx - yy);
  basis[7] = -c2 * x * z, basis[8] = Scalar<T>(0.5462742152960396) * (xx - yy);
  if (degree < 3) return;
  const Scalar<T> c3 = Scalar<T>(0.5900435899266435), c5 = Scalar<T>(0.4570457994644658);
  basis[9] = -c3 * y * (3 * xx - yy);
  basis[10] = Scalar<T>(2.890611442640554) * x * y * z;
  basis[11] = -c5 * y * (4 * zz - xx - yy);
  basis[12] = Scalar<T>(0.3731763325901154) * z * (2 * zz - 3 * xx - 3 * yy);
  basis[13] = -c5 * x * (4 * zz - xx - yy);
  basis[14] = Scalar<T>(1.445305721320277) * z * (xx - yy);
  basis[15] = -c3 * x * (xx - 3 * yy);
}

// Sum over k of weight[k] times the gradient of the polynomial basis[k] in (x, y, z).
template <class T>
GS_HD Vec3<T> sh_basis_vjp(int degree, Vec3<T> d, const T* weight) {
  Vec3<T> g = {};
  if (degree < 1) return g;
  const T x = d.x, y = d.y, z = d.z;
  const Scalar<T> c1 = Scalar<T>(0.4886025119029199);
  g = {-c1 * weight[3], -c1 * weight[1], c1 * weight[2]};
  if (degree < 2) return g;
  const Scalar<T> c2 = Scalar<T>(1.0925484305920792);
  const T w4 = c2 * weight[4], w5 = -c2 * weight[5], w6 = 2 * Scalar<T>(0.31539156525252005) * weight[6];
  const T w7 = -c2 * weight[7], w8 = 2 * Scalar<T>(0.5462742152960396) * weight[8];
  g.x += w4 * y + w7 * z + (w8 - w6) * x;
  g.y += w4 * x + w5 * z - (w8 + w6) * y;
  g.z += w5 * y + w7 * x + 2 * w6 * z;
  if (degree < 3) return g;
  const T xx = x * x, yy = y * y, zz = z * z;
  const Scalar<T> c3 = Scalar<T>(0.5900435899266435), c5 = Scalar<T>(0.4570457994644658);
  const T w9 = -c3 * weight[9], w10 = Scalar<T>(2.890611442640554) * weight[10], w11 = -c5 * weight[11];
  const T w12 = Scalar<T>(0.3731763325901154) * weight[12], w13 = -c5 * weight[13];
  const T w14 = Scalar<T>(1.445305721320277) * weight[14], w15 = -c3 * weight[15];
  g.x += w9 * 6 * x * y + w10 * y * z - w11 * 2 * x * y - w12 * 6 * x * z + w13 * (4 * zz - 3 * xx - yy) +
         w14 * 2 * x * z + w15 * 3 * (xx - yy);
  g.y += w9 * 3 * (xx - yy) + w10 * x * z + w11 * (4 * zz - xx - 3 * yy) - w12 * 6 * y * z - w13 * 2 * x * y -
         w14 * 2 * y * z - w15 * 6 * x * y;
  g.z += w10 * x * y + w11 * 8 * y * z + w12 * (6 * zz - 3 * xx - 3 * yy) + w13 * 8 * x * z + w14 * (xx - yy);
  return g;
}

// d = v / |v|. The zero vector stays zero, which leaves only degree 0 of the colour. Returns |v|.
template <class T>
GS_HD T sh_direction(Vec3<T> v, Vec3<T>& d) {
  const T norm = length(v);
  const T zero = {};
  d = {norm > 0 ? v.x / norm : zero, norm > 0 ? v.y / norm : zero, norm > 0 ? v.z / norm : zero};
  return norm;
}

template <class T>
GS_HD Vec3<T> sh_direction_vjp(Vec3<T> d, T norm, Vec3<T> g) {
  const Vec3<T> across = (1 / norm) * (g - dot(d, g) * d);
  const T zero = {};
  return {norm > 0 ? across.x : zero, norm > 0 ? across.y : zero, norm > 0 ? across.z : zero};
}

// The colour before the clamp at 0: 1/2 + sum_k basis[k] coefficient_k. dc is coefficient 0, rest has the others.
template <class T>
GS_HD Vec3<T> sh_color(int degree, const T* basis, Vec3<T> dc, const T* rest) {
  const Scalar<T> half = Scalar<T>(0.5);
  Vec3<T> c = Vec3<Scalar<T>>{half, half, half} + basis[0] * dc;
  const int active = sh_count(degree);
  for (int k = 1; k < sh_count(kMaxShDegree); ++k)  // constant length: a GPU keeps the basis in registers
    if (k < active) c = c + basis[k] * load3(rest + 3 * (k - 1));
  return c;
}

GS_ISA_END
