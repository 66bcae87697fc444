#pragma once
// Splats on rays (ray.h) at pixels: the exponent, and which pixels and tiles a splat reaches.
#include "blend.h"
#include "ray.h"

GS_ISA_BEGIN

template <class T>
struct LocalRaySplat : LocalSplat<T> {
  T slope_u, slope_v, e;
};

template <class T>
GS_HD LocalRaySplat<T> localise(const RaySplat<T>& splat, T left, T top) {
  const Splat<T>& on_image = splat;
  return {localise(on_image, left, top), splat.slope_u, splat.slope_v, splat.e};
}

// Along a row of pixels: u = row_u(flat, x), v is constant, s = s0 + slope_u u. flat.top is the opacity's.
template <class T>
struct RayRow {
  RowTerms<T> flat;
  T s0, slope_u, e;
};

template <class T>
GS_HD RayRow<T> ray_row(const RowTerms<T>& flat, T slope_u, T slope_v, T e) {
  return {flat, multiply_add(slope_v, flat.v, all<T>(1)), slope_u, e};
}
template <class V, class Y>
GS_HD RayRow<V> row_terms(const LocalRaySplat<V>& s, Y y) {
  const V u0 = multiply_add(s.l12, V{} + (y - float(kTileCentre)), s.u);
  return ray_row<V>({s.log2_opacity, s.l11, u0, s.l22 * (y - s.y)}, s.slope_u, s.slope_v, s.e);
}

template <class V>
struct AtPixel {
  V u, s, q;
  V inverse;  // 1 / (s^2 + e q)
};

// 1 / a, on a GPU by its own instruction alone: 1 unit in the last place off.
template <class V>
GS_HD V reciprocal(V a) {
#if defined(__CUDACC__) && defined(__CUDA_ARCH__)
  asm("rcp.approx.ftz.f32 %0, %0;" : "+f"(a));
  return a;
#else
  return 1 / a;
#endif
}

// Fused by name, as in blend.h, here and below. T: V or its scalar.
template <class V, class T>
GS_HD AtPixel<V> at_pixel(const RayRow<T>& row, V x) {
  AtPixel<V> p;
  p.u = row_u(row.flat, x);
  p.s = multiply_add(V(row.slope_u - V{}), p.u, V(row.s0 - V{}));
  p.q = multiply_add(p.u, p.u, V(row.flat.v * row.flat.v - V{}));
  p.inverse = reciprocal(multiply_add(V(row.e - V{}), p.q, V(p.s * p.s)));
  return p;
}
template <class V, class T>
GS_HD V row_exponent(const RayRow<T>& row, const AtPixel<V>& p) {
  const V q = p.s > Scalar<V>(0) ? p.q : all<V>(INFINITY);  // not at all behind the camera
  return multiply_add(V(-q), p.inverse, V(row.flat.top - V{}));
}

// The same of a splat that is not on rays: u alone.
template <class V, class T>
GS_HD V at_pixel(const RowTerms<T>& row, V x) {
  return row_u(row, x);
}
template <class Row, class V>
GS_HD V exponent_at(const Row& row, V x) {
  return row_exponent(row, at_pixel(row, x));
}

// As for EWA: u^2 is at least its least in the row's part, and s at most its larger end. D^2 grows with q, so none of
// its pixels has less than that of both.
template <class V, class T>
GS_HD auto row_reached(const RayRow<V>& row, T first, T last) {
  const T half = (last - first) / 2, centre = (last + first) / 2 - T(kTileCentre), margin = T(1e-5);
  const auto size = [](V a) { return larger(a, V(-a)); };
  const V u = row.flat.l11 * centre + row.flat.u0;
  const V wide = size(row.flat.l11) * (half + margin * T(kTileCentre)) + size(row.flat.u0) * margin;
  const V least = larger(V(size(u) - wide), V{});
  const V most = row.s0 + row.slope_u * u + size(row.slope_u) * wide + margin * (1 + size(row.s0));
  const V q = least * least + row.flat.v * row.flat.v;
  return (most > T(0)) & (row.flat.top + T(1e-3) - q * T(0.9999) / (most * most + row.e * q) >= T(kLog2MinAlpha));
}

// What RayMoments take of a pixel that is reached, without the gradient's factor; a lane that is not may have anything.
template <class V>
struct RayWeights {
  V u, v, p;  // root(w) x and root(w) p, which is D^2
  V au, av;   // w a / s
};

// root(w) / s is s / (s^2 + e q). a is multiplied out with s: nothing cancels where s is large.
template <class V, class T>
GS_HD RayWeights<V> ray_weights(const RayRow<V>& row, const AtPixel<V>& at, T slope_v) {
  const V per = at.s * at.inverse, u = per * at.u, v = per * row.flat.v;
  const V turn = multiply_add(V(slope_v - V{}), at.u, V(-row.slope_u * row.flat.v));
  return {u, v, at.q * at.inverse, at.inverse * multiply_add(turn, v, u), at.inverse * multiply_add(V(-turn), u, v)};
}

// The same of all pixels of a row, along which v is constant and s is linear in u: sums of q, of g u^k with
// g = q s / (s^2 + e q)^2, the q in it the exponent's, and of what weighs p^2.
template <class T>
struct RayRowSums {
  T q = 0, g = 0, gu = 0, guu = 0, guuu = 0, pp = 0;

  GS_HD void add(const AtPixel<T>& at, T q_here) {
    const T g_here = q_here * (at.s * at.inverse) * at.inverse, gu_here = g_here * at.u, guu_here = gu_here * at.u;
    const T p = at.q * at.inverse;
    q += q_here, g += g_here, gu += gu_here, guu += guu_here, guuu += guu_here * at.u, pp += q_here * p * p;
  }

  GS_HD RayMoments<T> moments(const RayRow<T>& row, T slope_v) const {
    const T v = row.flat.v, across = row.slope_u * v, square = v * v;
    const T one = row.s0 * g + row.slope_u * gu, u = row.s0 * gu + row.slope_u * guu;
    return {{q, row.s0 * gu - across * (v * g), v * g + across * gu - slope_v * guu, row.s0 * guu + row.slope_u * guuu,
             v * u, square * one},
            guuu + square * gu,
            v * (guu + square * g),
            pp};
  }
};

// How far from the mean a splat reaches, px.
template <class T>
struct Extent {
  T left, right, up, down;
};

// q <= reach: the ellipse (u, v) = L d / s of that size, d / s = L^-1 (u, v) and 1 / s = 1 - slope (u, v). A bound x of
// dx is tangent to it where reach |r + x slope|^2 = x^2, r a row of L^-1. Where the ellipse passes the camera's plane,
// or contains the camera, the splat may reach everything.
template <class T>
GS_HD Extent<T> extent_of(const RaySplat<T>& s) {
  using Number = Scalar<T>;
  const T far = all<T>(1e9), level = larger(s.log2_opacity - Number(kLog2MinAlpha), T{});
  const T deviations = root(level) * Number(1.0001) + Number(0.01), square = deviations * deviations;
  const T outside = 1 - s.e * square, reach = square / outside;
  const T rest = 1 - reach * (s.slope_u * s.slope_u + s.slope_v * s.slope_v);
  const Truth<T> bounded = (outside > Number(1e-3)) & (rest > Number(1e-3));
  const auto bound = [&](T ru, T rv, T& less, T& more) {
    const T skew = reach * (ru * s.slope_u + rv * s.slope_v);
    const T wide = root(larger(skew * skew + rest * reach * (ru * ru + rv * rv), T{}));
    less = bounded ? (wide - skew) / rest + wide / rest * Number(1e-3) + Number(0.01) : far;
    more = bounded ? (wide + skew) / rest + wide / rest * Number(1e-3) + Number(0.01) : far;
  };
  Extent<T> to;
  bound(1 / s.l11, -s.l12 / s.l22 / s.l11, to.left, to.right);
  bound(T{}, 1 / s.l22, to.up, to.down);
  return to;
}

template <class T>
GS_HD Rect<Integer<T>> tile_rect(const RaySplat<T>& s, int width, int height, bool) {
  const Extent<T> to = extent_of(s);
  const Truth<T> some = s.log2_opacity - Scalar<T>(kLog2MinAlpha) > Scalar<T>(-1e-3);
  return tiles_between<T>(some, s.x - to.left, s.x + to.right, s.y - to.up, s.y + to.down, width, height);
}

// The flat test with the level reach s^2, where s is the largest at the box's corners: this may keep a tile that no
// pixel needs, but never drops one.
template <class T>
struct RayTileTest : TileTest<T> {
  T by_x, by_y;  // of s, per px
  T reach, margin;
};

template <class T>
GS_HD RayTileTest<T> make_tile_test(const RaySplat<T>& s, TileRect rect, int width, int height) {
  const Splat<T>& on_image = s;
  const TileTest<T> flat = make_tile_test(on_image, rect, width, height);
  const T level = s.log2_opacity - T(kLog2MinAlpha) + T(1e-3), outside = 1 - s.e * level;
  const T reach = outside > T(1e-3) ? level / outside * T(1.0001) : T(1e30);
  return {flat, s.l11 * s.slope_u, s.l12 * s.slope_u + s.l22 * s.slope_v, reach,
          flat.level - (s.log2_opacity - T(kLog2MinAlpha)) + T(1e-3)};
}

template <class T, class V>
GS_HD auto box_reached(const RayTileTest<T>& test, V left, V right, V top, V bottom) {
  const Splat<T>& at = test.splat;
  const V x0 = test.by_x * (left - at.x), x1 = test.by_x * (right - at.x);
  const V y0 = test.by_y * (top - at.y), y1 = test.by_y * (bottom - at.y);
  const V s = T(1.0001) * (1 + larger(x0, x1) + larger(y0, y1)) + T(1e-4);
  const V level = s > T(0) ? test.reach * s * s + test.margin * (1 + s) : V{} - 1;
  return box_reached<T>(test, level, left, right, top, bottom);
}

GS_ISA_END
