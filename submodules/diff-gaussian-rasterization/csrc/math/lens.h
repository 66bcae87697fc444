#pragma once
// Where a lens shows a point of the view, with first and second derivatives: COLMAP's camera models.
//
// A chart makes a direction two numbers: the perspective one x / z and y / z, the equidistant one the angle from the
// axis along both, the equirectangular one longitude and latitude. A distortion changes them: with q = a^2 + b^2
//   a' = a R(q) + 2 p1 a b + p2 (q + 2 a^2) + s1 q,   b' = b R(q) + 2 p2 a b + p1 (q + 2 b^2) + s2 q,
//   R = (1 + k1 q + k2 q^2 + k3 q^3 + k4 q^4) / (1 + d1 q + d2 q^2 + d3 q^3)
// (Brown 1966; thin prism: Weng et al. 1992). Focal lengths and principal point make them pixels.
#include <cmath>

#include "../data.h"
#include "constants.h"
#include "vec.h"

GS_ISA_BEGIN

// Two functions of a point and their derivatives: by x, y, z, and by xx, xy, xz, yy, yz, zz.
template <class V>
struct OnLens {
  V value[2], first[2][3], second[2][6];
  V field;  // the sum of squares of the chart's numbers
};

// f(t) = atan(t) / t of t^2 = u, and its first two derivatives by u.
template <class T>
struct Angle {
  T f, first, second;
};

// The series for u <= 1/4, else the function itself: there the differences lose three bits at most.
template <class T>
GS_HD Angle<T> angle_near(T u) {
  Angle<T> a = {};
  for (int n = sizeof(T) == sizeof(float) ? 12 : 27; n >= 0; --n) {
    const T c = T(n & 1 ? -1 : 1) / T(2 * n + 1);
    a.second = a.second * u + 2 * a.first, a.first = a.first * u + a.f, a.f = a.f * u + c;
  }
  return a;
}

// The equidistant chart is s (x, y), s = theta / r, of q = r^2 and z: s, its derivatives by q and z, and by qq, qz, zz.
template <class T>
struct Stretch {
  T s, q, z, qq, qz, zz;
};

template <class T>
GS_HD Stretch<T> stretch(T q, T z) {
  const T rho2 = q + z * z, rho4 = rho2 * rho2;
  Stretch<T> e;
  e.z = -1 / rho2, e.qz = 1 / rho4, e.zz = 2 * z / rho4;
  if (z > 0 && 4 * q <= z * z) {
    const T inverse = 1 / z, inverse2 = inverse * inverse;
    const Angle<T> a = angle_near(q * inverse2);
    e.s = a.f * inverse, e.q = a.first * inverse * inverse2, e.qq = a.second * inverse * inverse2 * inverse2;
  } else {
    const T r = std::sqrt(q);
    e.s = std::atan2(r, z) / r;
    e.q = (z / rho2 - e.s) / (2 * q), e.qq = -(z / rho4 + 3 * e.q) / (2 * q);
  }
  return e;
}

// A panorama stretches what is close to a pole without bound. Points within kPole of it, an angle, count as lying
// there.
template <class T>
GS_HD Vec3<T> off_pole(Vec3<T> p) {
  const T h = std::sqrt(p.x * p.x + p.z * p.z), least = T(kPole) * magnitude(p.y);
  if (h >= least) return p;
  if (h > least * T(1e-12)) return {p.x * (least / h), p.y, p.z * (least / h)};
  return {T(0), p.y, least};
}

template <class T>
GS_HD OnLens<T> on_chart(Chart chart, Vec3<T> p) {
  OnLens<T> c = {};
  if (chart == Chart::kPerspective) {
    const T w = 1 / p.z, w2 = w * w;
    c.value[0] = p.x * w, c.value[1] = p.y * w;
    c.first[0][0] = w, c.first[0][2] = -p.x * w2;
    c.first[1][1] = w, c.first[1][2] = -p.y * w2;
    c.second[0][2] = -w2, c.second[0][5] = 2 * p.x * w2 * w;
    c.second[1][4] = -w2, c.second[1][5] = 2 * p.y * w2 * w;
  } else if (chart == Chart::kEquidistant) {
    const Stretch<T> e = stretch(p.x * p.x + p.y * p.y, p.z);
    const T along[2] = {p.x, p.y};
    // By x: 2 x d/dq; by xx: 2 d/dq + 4 x^2 d2/dq2.
    const T s1[3] = {2 * p.x * e.q, 2 * p.y * e.q, e.z};
    const T s2[6] = {2 * e.q + 4 * p.x * p.x * e.qq, 4 * p.x * p.y * e.qq, 2 * p.x * e.qz,
                     2 * e.q + 4 * p.y * p.y * e.qq, 2 * p.y * e.qz,       e.zz};
    for (int i = 0; i < 2; ++i) {
      c.value[i] = e.s * along[i];
      for (int k = 0; k < 3; ++k) c.first[i][k] = s1[k] * along[i];
      c.first[i][i] += e.s;
      for (int k = 0; k < 6; ++k) c.second[i][k] = s2[k] * along[i];
    }
    c.second[0][0] += 2 * s1[0], c.second[0][1] += s1[1], c.second[0][2] += s1[2];
    c.second[1][1] += s1[0], c.second[1][3] += 2 * s1[1], c.second[1][4] += s1[2];
  } else {
    p = off_pole(p);
    const T h2 = p.x * p.x + p.z * p.z, h = std::sqrt(h2), rho2 = h2 + p.y * p.y;
    const T w = 1 / h2, w2 = w * w, v = 1 / rho2, v2 = v * v, h1 = 1 / h;
    c.value[0] = std::atan2(p.x, p.z), c.value[1] = std::atan2(p.y, h);
    c.first[0][0] = p.z * w, c.first[0][2] = -p.x * w;
    c.second[0][0] = -2 * p.x * p.z * w2, c.second[0][5] = -c.second[0][0];
    c.second[0][2] = (p.x * p.x - p.z * p.z) * w2;
    // Latitude of h and y: by h -y / rho^2, by y h / rho^2.
    const T by_h = -p.y * v, by_y = h * v, hh = 2 * p.y * h * v2, hy = (p.y * p.y - h2) * v2, yy = -hh;
    const T hx = p.x * h1, hz = p.z * h1, cube = h1 * w;
    c.first[1][0] = by_h * hx, c.first[1][1] = by_y, c.first[1][2] = by_h * hz;
    c.second[1][0] = hh * hx * hx + by_h * p.z * p.z * cube;
    c.second[1][1] = hy * hx;
    c.second[1][2] = hh * hx * hz - by_h * p.x * p.z * cube;
    c.second[1][3] = yy;
    c.second[1][4] = hy * hz;
    c.second[1][5] = hh * hz * hz + by_h * p.x * p.x * cube;
  }
  return c;
}

// A distorted pair of numbers, derivatives by a and b, and by aa, ab, bb.
template <class T>
struct Distorted {
  T value[2], first[2][2], second[2][3];
};

// R of q = a^2 + b^2 with two derivatives, and its divisor with one.
template <class T>
struct Radial {
  T r, r1, r2, divisor, divisor1;
};

template <class T>
GS_HD Radial<T> radial_of(const Lens<T>& lens, T q) {
  const T *k = lens.radial, *d = lens.divisor;
  const T n0 = 1 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3])));
  const T n1 = k[0] + q * (2 * k[1] + q * (3 * k[2] + q * 4 * k[3]));
  const T n2 = 2 * k[1] + q * (6 * k[2] + q * 12 * k[3]);
  const T m0 = 1 + q * (d[0] + q * (d[1] + q * d[2])), m1 = d[0] + q * (2 * d[1] + q * 3 * d[2]);
  const T m2 = 2 * d[1] + q * 6 * d[2];
  const T r = n0 / m0, r1 = (n1 - r * m1) / m0, r2 = (n2 - 2 * r1 * m1 - r * m2) / m0;
  return {r, r1, r2, m0, m1};
}

template <class T>
GS_HD Distorted<T> distort(const Lens<T>& lens, T a, T b) {
  const T q = a * a + b * b;
  const Radial<T> radial = radial_of(lens, q);
  const T r = radial.r, r1 = radial.r1, r2 = radial.r2;
  // One formula for both numbers: of u with v beside it, along which the tangential terms are t and o.
  const auto one = [&](T u, T v, T t, T o, T s, T& value, T& by_u, T& by_v, T& uu, T& uv, T& vv) {
    value = u * r + 2 * t * u * v + o * (q + 2 * u * u) + s * q;
    by_u = r + 2 * u * u * r1 + 2 * t * v + 6 * o * u + 2 * s * u;
    by_v = 2 * u * v * r1 + 2 * t * u + 2 * o * v + 2 * s * v;
    uu = 6 * u * r1 + 4 * u * u * u * r2 + 6 * o + 2 * s;
    uv = 2 * v * r1 + 4 * u * u * v * r2 + 2 * t;
    vv = 2 * u * r1 + 4 * u * v * v * r2 + 2 * o + 2 * s;
  };
  Distorted<T> out;
  const T p1 = lens.tangential[0], p2 = lens.tangential[1];
  one(a, b, p1, p2, lens.prism[0], out.value[0], out.first[0][0], out.first[0][1], out.second[0][0], out.second[0][1],
      out.second[0][2]);
  one(b, a, p2, p1, lens.prism[1], out.value[1], out.first[1][1], out.first[1][0], out.second[1][2], out.second[1][1],
      out.second[1][0]);
  return out;
}

// The pixel of a point of the view, with derivatives; the second ones for kOrder 2.
template <int kOrder, class T>
GS_HD OnLens<T> on_lens(const Lens<T>& lens, Vec3<T> p) {
  constexpr int kPairs[6][2] = {{0, 0}, {0, 1}, {0, 2}, {1, 1}, {1, 2}, {2, 2}};
  const OnLens<T> c = on_chart(lens.chart, p);
  const Distorted<T> d = distort(lens, c.value[0], c.value[1]);
  const T focal[2] = {lens.focal_x, lens.focal_y}, center[2] = {lens.center_x, lens.center_y};
  const auto& a = c.first[0];
  const auto& b = c.first[1];
  OnLens<T> out = {};
  out.field = c.value[0] * c.value[0] + c.value[1] * c.value[1];
  for (int i = 0; i < 2; ++i) {
    const T by_a = focal[i] * d.first[i][0], by_b = focal[i] * d.first[i][1];
    out.value[i] = focal[i] * d.value[i] + center[i];
    for (int k = 0; k < 3; ++k) out.first[i][k] = by_a * a[k] + by_b * b[k];
    for (int k = 0; kOrder > 1 && k < 6; ++k) {
      const int m = kPairs[k][0], n = kPairs[k][1];
      const T mixed =
          d.second[i][0] * a[m] * a[n] + d.second[i][1] * (a[m] * b[n] + a[n] * b[m]) + d.second[i][2] * b[m] * b[n];
      out.second[i][k] = by_a * c.second[0][k] + by_b * c.second[1][k] + focal[i] * mixed;
    }
  }
  return out;
}

GS_ISA_END
