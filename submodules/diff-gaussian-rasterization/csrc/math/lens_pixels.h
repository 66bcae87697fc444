#pragma once
// Splats on the rays of a lens (lens_rays.h) at pixels.
//
// A tile has a frame: a direction and its changes by a pixel to the right and down. In it the directions of the tile's
// pixels are frame.at + x frame.across + y frame.down, but for their lengths, and so pixels of a pinhole: at places
// (x, y) that differ a little from the numbers of columns and rows. u, v and s are linear in the place.
#include "ray_pixels.h"

GS_ISA_BEGIN

// The places of the tile's pixels lie between the limits; where it has none, x0 > x1.
template <class T>
struct TileFrame {
  Vec3<T> at, across, down;
  T x0, x1, y0, y1;
  T none[3];
};
constexpr int kFrameValues = 16, kPlaceValues = 2 * kTile * kTile;
static_assert(sizeof(TileFrame<float>) == kFrameValues * sizeof(float), "a row of frames");

// A table of a lens: the frames of all tiles, then of each the x of its pixels, row by row, and their y; NaN where the
// lens shows nothing.
GS_HD int64_t lens_table_values(Image image) { return tiles_of(image) * (kFrameValues + kPlaceValues); }
template <class T>
GS_HD const T* places_of(const T* table, Image image, int64_t tile) {
  return table + tiles_of(image) * kFrameValues + tile * kPlaceValues;
}

template <class T>
GS_HD TileFrame<T> frame_at(const T* table, int64_t tile) {
  const T* f = table + kFrameValues * tile;
  return {load3(f), load3(f + 3), load3(f + 6), f[9], f[10], f[11], f[12], {}};
}

template <class V>
struct Place {
  V x, y;
};

// Limits of some places.
template <class T>
struct PlaceBox {
  T x0, x1, y0, y1;
};

template <class T>
struct Linear {
  T one, x, y;
};

// What a splat is in a tile's frame.
template <class T>
struct LensTerms {
  Linear<T> u, v, s;
  T e, log2_opacity, slope_u, slope_v;
};

// Products of directions are computed in double: far from the mean's they cancel.
template <class T>
GS_HD LensTerms<T> lens_terms(const LensRaySplat<T>& s, const TileFrame<T>& f) {
  const auto by = [&](Vec3<T> a, Vec3<T> b) { return double(a.x) * b.x + double(a.y) * b.y + double(a.z) * b.z; };
  const auto linear = [&](Vec3<T> a) { return Linear<double>{by(a, f.at), by(a, f.across), by(a, f.down)}; };
  const Linear<double> u = linear(s.to_u), v = linear(s.to_v), n = linear(s.n);
  const double along = s.slope_u, aside = s.slope_v;
  return {{T(u.one), T(u.x), T(u.y)},
          {T(v.one), T(v.x), T(v.y)},
          {T(n.one + along * u.one + aside * v.one), T(n.x + along * u.x + aside * v.x),
           T(n.y + along * u.y + aside * v.y)},
          s.e,
          s.log2_opacity,
          s.slope_u,
          s.slope_v};
}

template <class V>
struct AtPlace : AtPixel<V> {
  V v;
};

template <class V, class T>
GS_HD V at_place(const Linear<T>& a, const Place<V>& place) {
  return multiply_add(V(a.y - V{}), place.y, multiply_add(V(a.x - V{}), place.x, V(a.one - V{})));
}
template <class V, class T>
GS_HD AtPlace<V> at_pixel(const LensTerms<T>& terms, const Place<V>& place) {
  AtPlace<V> p;
  p.u = at_place(terms.u, place), p.v = at_place(terms.v, place), p.s = at_place(terms.s, place);
  p.q = multiply_add(p.u, p.u, V(p.v * p.v));
  p.inverse = reciprocal(multiply_add(V(terms.e - V{}), p.q, V(p.s * p.s)));
  return p;
}
template <class V, class T>
GS_HD V row_exponent(const LensTerms<T>& terms, const AtPlace<V>& p) {
  const V q = p.s > Scalar<V>(0) ? p.q : all<V>(INFINITY);
  return multiply_add(V(-q), p.inverse, V(terms.log2_opacity - V{}));
}
template <class V, class T>
GS_HD V exponent_at(const LensTerms<T>& terms, const Place<V>& place) {
  return row_exponent(terms, at_pixel(terms, place));
}

// As for a pinhole, with w a / s times n r.
template <class V, class T>
GS_HD RayWeights<V> ray_weights(const LensTerms<T>& terms, const AtPlace<V>& at) {
  const V slope_u = terms.slope_u - V{}, slope_v = terms.slope_v - V{};
  const V per = at.s * at.inverse, u = per * at.u, v = per * at.v;
  const V depth = multiply_add(V(-slope_v), at.v, multiply_add(V(-slope_u), at.u, at.s));
  const V turn = multiply_add(slope_v, at.u, V(-slope_u * at.v)), weight = depth * at.inverse;
  return {u, v, at.q * at.inverse, weight * multiply_add(turn, v, V(depth * u)),
          weight * multiply_add(V(-turn), u, V(depth * v))};
}

// The same of all pixels that a lane takes, as a gradient row has them.
template <class T>
struct PlaceSums {
  T q = 0, u = 0, v = 0, uu = 0, uv = 0, vv = 0, pu = 0, pv = 0, pp = 0;

  GS_HD void add(const LensTerms<T>& terms, const AtPlace<T>& at, T q_here) {
    const RayWeights<T> w = ray_weights(terms, at);
    const T along = q_here * w.u, down = q_here * w.v, deep = q_here * w.p;
    q += q_here, u = multiply_add(q_here, w.au, u), v = multiply_add(q_here, w.av, v);
    uu += along * w.u, uv += along * w.v, vv += down * w.v, pu += deep * w.u, pv += deep * w.v, pp += deep * w.p;
  }
  GS_HD RayMoments<T> moments() const { return {{q, u, v, uu, uv, vv}, pu, pv, pp}; }
};

// Whether a splat may reach a place of the box: V may be a vector of splats or of boxes, B its scalar or V. u and v of
// the box are a parallelogram around c, of the halves a and b. If all of it lies beyond sqrt(reach) s along the normal
// of a side or along c, the splat does not. `reach` is infinite if the splat reaches every direction in front.
template <class V, class B>
GS_HD auto box_reached(const LensTerms<V>& t, const PlaceBox<B>& box) {
  using T = Scalar<V>;
  const B half_x = (box.x1 - box.x0) / 2, half_y = (box.y1 - box.y0) / 2;
  const B mid_x = (box.x1 + box.x0) / 2, mid_y = (box.y1 + box.y0) / 2;
  const auto middle = [&](const Linear<V>& l) { return V(l.one + l.x * mid_x + l.y * mid_y); };
  const V cu = middle(t.u), cv = middle(t.v), au = t.u.x * half_x, av = t.v.x * half_x;
  const V bu = t.u.y * half_y, bv = t.v.y * half_y;
  const V s = middle(t.s) + magnitude(V(t.s.x * half_x)) + magnitude(V(t.s.y * half_y));
  const V level = t.log2_opacity - T(kLog2MinAlpha) + T(1e-2), outside = 1 - t.e * level;
  const V most = T(1.0002) * s + T(1e-4), bound = level / outside * T(1.0002) * most * most;
  const auto beyond = [&](V part, V of, V rounding, V square) {
    const V least = part - of - T(4e-6) * rounding;
    return (least > T(0)) & (least * least > bound * square);
  };
  const auto across = [](V x, V y, V z, V w) { return magnitude(V(x * w - y * z)); };
  const auto rounding = [](V x, V y, V z, V w) { return V(magnitude(V(x * w)) + magnitude(V(y * z))); };
  const V area = across(au, av, bu, bv), square = cu * cu + cv * cv;
  const auto by_a = beyond(across(cu, cv, au, av), area, rounding(cu, cv, au, av), V(au * au + av * av));
  const auto by_b = beyond(across(cu, cv, bu, bv), area, rounding(cu, cv, bu, bv), V(bu * bu + bv * bv));
  const auto by_c =
      beyond(square, V(magnitude(V(cu * au + cv * av)) + magnitude(V(cu * bu + cv * bv))), square, square);
  return (most > T(0)) & (V{} + box.x1 >= V{} + box.x0) & ((outside < T(1e-3)) | !(by_a | by_b | by_c));
}

// The x of places that a splat may reach, as extent_of: around the place of its mean, (u, v) = 0, both are linear.
template <class T>
struct XLimits {
  T low, high;
};
template <class T>
GS_HD XLimits<T> x_limits(const LensTerms<T>& t) {
  const T level = larger(t.log2_opacity - T(kLog2MinAlpha), T(0)), deviations = root(level) * T(1.0001) + T(0.01);
  const T square = deviations * deviations, outside = 1 - t.e * square, reach = square / outside;
  const T per = 1 / (t.u.x * t.v.y - t.u.y * t.v.x);
  const T x = per * (t.u.y * t.v.one - t.v.y * t.u.one), y = per * (t.v.x * t.u.one - t.u.x * t.v.one);
  const T s = t.s.one + t.s.x * x + t.s.y * y, ru = per * t.v.y, rv = -per * t.u.y;
  const T slope_u = per * (t.s.x * t.v.y - t.s.y * t.v.x), slope_v = per * (t.s.y * t.u.x - t.s.x * t.u.y);
  const T rest = 1 - reach * (slope_u * slope_u + slope_v * slope_v);
  const T skew = reach * (ru * slope_u + rv * slope_v);
  const T wide = root(larger(skew * skew + rest * reach * (ru * ru + rv * rv), T(0)));
  const T margin = T(0.02) + T(1e-3) * (s * wide / rest + magnitude(x));
  if (!(outside > T(1e-3) && rest > T(1e-3) && s > T(1e-3)) || !is_finite(margin)) return {T(-INFINITY), T(INFINITY)};
  return {x - s * (wide - skew) / rest - margin, x + s * (wide + skew) / rest + margin};
}

// The tiles that a splat reaches, as TileTest. Counting and emission must agree, so products are fused by name.
template <class T>
struct LensTileTest {
  Vec3<T> u, v, s;
  T e, log2_opacity;
  const T* table;
  int columns;  // of tiles
};

template <class T>
GS_HD LensTileTest<T> make_tile_test(const LensRaySplat<T>& s, Image image, const T* table) {
  return {s.to_u,
          s.to_v,
          s.n + s.slope_u * s.to_u + s.slope_v * s.to_v,
          s.e,
          s.log2_opacity,
          table,
          tile_count(image.width)};
}

// f: a row of frames, of a tile or of several.
template <class T, class V>
GS_HD auto frame_reached(const LensTileTest<T>& test, const V* f) {
  const auto by = [&](const Vec3<T>& a, int at) {
    return multiply_add(f[at], V(a.x - V{}), multiply_add(f[at + 1], V(a.y - V{}), V(f[at + 2] * a.z)));
  };
  const auto linear = [&](const Vec3<T>& a) { return Linear<V>{by(a, 0), by(a, 3), by(a, 6)}; };
  const LensTerms<V> t = {
      linear(test.u), linear(test.v), linear(test.s), test.e - V{}, test.log2_opacity - V{}, {}, {}};
  return box_reached(t, PlaceBox<V>{f[9], f[10], f[11], f[12]});
}

GS_ISA_END
