#pragma once
// Projection through a lens: what projection.h takes from a pinhole, from the lens's derivatives (EWA with its
// Jacobian).
#include "footprint.h"
#include "lens.h"
#include "projection.h"

GS_ISA_BEGIN

template <class T>
struct LensCamera : Camera<T> {
  Lens<T> lens;
  bool around;  // a full panorama, whose left and right border are one
};

template <class T>
GS_HD bool goes_around(const Camera<T>&) {
  return false;
}
template <class T>
GS_HD bool goes_around(const LensCamera<T>& cam) {
  return cam.around;
}

// A point of the view on the image; p1 and p2 as in Perspective, but of the lens's Jacobian.
template <class V>
struct LensView {
  OnLens<V> on;
  Vec3<V> clamped;  // where the Jacobian is taken
  V inverse_depth;
  Vec3<V> p1, p2;
};

// Depth is z where the lens shows what is in front of it alone, else the distance.
template <class T, class V>
GS_HD V depth_of(const LensCamera<T>& cam, Vec3<V> view) {
  return cam.lens.chart == Chart::kPerspective ? view.z : length(view);
}
template <class T, class V>
GS_HD Truth<V> shown(const LensCamera<T>& cam, Vec3<V> view) {
  return in_front(cam, depth_of(cam, view));
}

// By lanes, because vectors have no arc tangent.
template <int kOrder, class T, class V>
GS_HD OnLens<V> on_lens_of(const Lens<T>& lens, Vec3<V> p) {
  if constexpr (kIsScalar<V>) {
    return on_lens<kOrder>(lens, p);
  } else {
    OnLens<V> out = {};
    for (int lane = 0; lane < int(sizeof(V) / sizeof(T)); ++lane) {
      const OnLens<T> one = on_lens<kOrder>(lens, Vec3<T>{p.x[lane], p.y[lane], p.z[lane]});
      for (int i = 0; i < 2; ++i) {
        out.value[i][lane] = one.value[i];
        for (int k = 0; k < 3; ++k) out.first[i][k][lane] = one.first[i][k];
        for (int k = 0; kOrder > 1 && k < 6; ++k) out.second[i][k][lane] = one.second[i][k];
      }
      out.field[lane] = one.field;
    }
    return out;
  }
}

// The point of the same depth on the ray clamped as a pinhole's, where the chart has a pinhole's rays.
template <class T, class V>
GS_HD Vec3<V> clamped(const LensCamera<T>& cam, Vec3<V> view, V inverse_depth) {
  if (cam.lens.chart != Chart::kPerspective) return view;
  const V x = view.x * inverse_depth, y = view.y * inverse_depth;
  const V to_x = clamp(x, all<V>(cam.ray_min_x), all<V>(cam.ray_max_x));
  const V to_y = clamp(y, all<V>(cam.ray_min_y), all<V>(cam.ray_max_y));
  return {to_x == x ? view.x : to_x * view.z, to_y == y ? view.y : to_y * view.z, view.z};
}

template <class T, class V>
GS_HD LensView<V> perspective(const LensCamera<T>& cam, Vec3<V> view) {
  LensView<V> p;
  p.on = on_lens_of<1>(cam.lens, view);
  p.inverse_depth = 1 / depth_of(cam, view);
  p.clamped = clamped(cam, view, p.inverse_depth);
  const Truth<V> apart = (p.clamped.x != view.x) | (p.clamped.y != view.y);
  const OnLens<V> there = any(apart) ? on_lens_of<1>(cam.lens, p.clamped) : p.on;
  const auto row = [&](const V* by) { return by[0] * cam.row_x + by[1] * cam.row_y + by[2] * cam.row_z; };
  p.p1 = row(there.first[0]), p.p2 = row(there.first[1]);
  return p;
}

template <class T, class V>
GS_HD Truth<V> image_point(const LensCamera<T>& cam, const LensView<V>& p, V& x, V& y) {
  x = p.on.value[0], y = p.on.value[1];
  return is_finite(x) & is_finite(y) & (p.on.field <= cam.lens.limit);
}

template <class T, class V>
GS_HD Footprint<V> splat_footprint(const LensCamera<T>&, const LensView<V>& p, const Axes<V>& axes) {
  const auto& d = axes.direction;
  const auto& s = axes.scale;
  const Vec3<V> normal = cross(p.p1, p.p2);
  const Vec3<V> minors = {s[1] * s[2] * dot(normal, cross(d[1], d[2])), s[2] * s[0] * dot(normal, cross(d[2], d[0])),
                          s[0] * s[1] * dot(normal, cross(d[0], d[1]))};
  return make_footprint(row_of(p.p1, axes), row_of(p.p2, axes), minors, axes.dilation);
}

// dP's rows on the axes of the view.
template <class T>
struct AlongAxes {
  T of[2][3];
};

template <class T, class V>
GS_HD AlongAxes<V> along_view(const LensCamera<T>& cam, const Axes<V>& axes, const V (&row1)[3], const V (&row2)[3]) {
  AlongAxes<V> along;
  for (int i = 0; i < 2; ++i) {
    Vec3<V> row = {};
    for (int k = 0; k < 3; ++k) row = row + (axes.scale[k] * (i ? row2[k] : row1[k])) * axes.direction[k];
    along.of[i][0] = dot(cam.row_x, row), along.of[i][1] = dot(cam.row_y, row), along.of[i][2] = dot(cam.row_z, row);
  }
  return along;
}

// The gradient of the point of the view. dP's rows meet the lens's second derivatives. A clamped coordinate follows z
// alone. bent: the gradient of the point that is clamped.
template <class T, class V>
GS_HD Vec3<V> view_vjp(const LensCamera<T>& cam, Vec3<V> view, const LensView<V>& p, const AlongAxes<V>& along,
                       V pixel_x, V pixel_y, V g_inverse_depth, V (&bent)[3]) {
  constexpr int kPair[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
  const OnLens<V> there = on_lens_of<2>(cam.lens, p.clamped);
  V g[3] = {};
  for (int i = 0; i < 2; ++i)
    for (int a = 0; a < 3; ++a) {
      g[a] += (i ? pixel_y : pixel_x) * p.on.first[i][a];
      for (int b = 0; b < 3; ++b) bent[a] += along.of[i][b] * there.second[i][kPair[a][b]];
    }
  const Vec3<V> c = p.clamped;
  g[0] += c.x == view.x ? bent[0] : V{}, g[1] += c.y == view.y ? bent[1] : V{};
  g[2] += bent[2] + (c.x == view.x ? V{} : bent[0] * c.x * p.inverse_depth) +
          (c.y == view.y ? V{} : bent[1] * c.y * p.inverse_depth);
  const V square = p.inverse_depth * p.inverse_depth * g_inverse_depth;
  if (cam.lens.chart == Chart::kPerspective) {
    g[2] -= square;
  } else {
    const V each = square * p.inverse_depth;
    g[0] -= each * view.x, g[1] -= each * view.y, g[2] -= each * view.z;
  }
  return {g[0], g[1], g[2]};
}

template <class T, class V>
GS_HD Vec3<V> position_vjp(const LensCamera<T>& cam, Vec3<V> view, const LensView<V>& p, const AlongAxes<V>& along,
                           Vec3<V>, V pixel_x, V pixel_y, V g_inverse_depth) {
  V bent[3] = {};
  const Vec3<V> g = view_vjp(cam, view, p, along, pixel_x, pixel_y, g_inverse_depth, bent);
  return g.x * cam.row_x + g.y * cam.row_y + g.z * cam.row_z;
}

GS_ISA_END
