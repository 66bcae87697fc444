#pragma once
// Blocks of Gaussians that sleep through steps whose views cannot show them, and what these steps come to.
//
// A value without a gradient goes on by its averages alone. With m and v after step t, step t + j moves it by
//   -lr c m_j / sqrt(v_j),  m_j = beta1^j m,  v_j = beta2^j v,  c = sqrt(1 - beta2^(t + j)) / (1 - beta1^(t + j)),
// as long as sqrt(v_j) is far above epsilon. That is -lr c rho^j m / sqrt(v), rho = beta1 / sqrt(beta2). So k such
// steps are one: the value moves by -A m / sqrt(v), A = sum of lr c rho^j over j from 1 to k, and the averages are
// multiplied by beta1^k and beta2^k. Epsilon is taken as of step t. Against k steps one by one this differs by
// rounding.
//
// |m| / sqrt(v) is at most (1 - beta1) / sqrt((1 - beta2) (1 - beta1^2 / beta2)), by Cauchy and Schwarz over the
// gradients that m and v are sums of: 7.27 for the usual decays. So A bounds how far a sleeping value can have moved.
#include "../data.h"
#include "exponential.h"
#include "lens_camera.h"
#include "projection.h"

GS_ISA_BEGIN

// The steps that one attribute of a block has missed.
template <class T>
struct MissedSum {
  T sum;           // A
  T keep1, keep2;  // beta1^k, beta2^k
  T eps;           // epsilon sqrt(1 - beta2^t)
  T most;          // the bound of |m| / sqrt(v), which averages from elsewhere may pass
};

// The same of all attributes, by the number of missed steps.
template <class T>
struct MissedSums {
  T sum[kStepped][kTerms];
  T keep1[kTerms], keep2[kTerms], eps[kTerms], most;

  GS_HD MissedSum<T> of(int attribute, int64_t missed) const {
    return {sum[attribute][missed], keep1[missed], keep2[missed], eps[missed], most};
  }
  // The farthest that a value of the attribute can have moved.
  GS_HD T reach(int attribute, int64_t missed) const { return most * sum[attribute][missed]; }

  // Fills an attribute's sums before step `number`. The sum of k + 1 steps is that of the last k, which is one decay
  // older, and one step more.
  GS_HD void add_up(const AdamInput<T>& in, const T* terms, int attribute, int64_t number) {
    const double decay = in.beta1 / std::sqrt(in.beta2);
    double total = 0;
    for (int64_t k = 0; k < kTerms; ++k) {
      sum[attribute][k] = T(total);
      total = decay * (total + terms[((number - 1 - k) & (kTerms - 1)) * kTermColumns + attribute]);
    }
  }
  GS_HD void set_decays(const AdamInput<T>& in, int64_t number, int64_t missed) {
    const int64_t taken = number - 1 - missed;
    keep1[missed] = T(std::pow(in.beta1, double(missed)));
    keep2[missed] = T(std::pow(in.beta2, double(missed)));
    eps[missed] = T(in.eps * std::sqrt(1 - std::pow(in.beta2, double(taken > 0 ? taken : 1))));
    most = T((1 - in.beta1) / std::sqrt((1 - in.beta2) * (1 - in.beta1 * in.beta1 / in.beta2)));
  }
};

// The steps that a block has missed before step `number`; below 0 where that step is repeated.
GS_HD int64_t missed_before(int64_t number, int64_t taken) {
  const int64_t missed = number - 1 - taken;
  return missed < kTerms ? missed : kTerms - 1;
}

// Where the result would not be finite, the value stays, as in adam_if_finite.
template <class T>
GS_HD void take_missed(const MissedSum<T>& missed, T& value, T& mean, T& square) {
  const T ratio = mean / (std::sqrt(square) + missed.eps);
  const T moved = multiply_add(-missed.sum, clamp(ratio, -missed.most, missed.most), value);
  const bool finite = is_finite(moved) & is_finite(mean);
  value = finite ? moved : value;
  mean = finite ? mean * missed.keep1 : T(NAN);
  square *= missed.keep2;
}

// What tests a block: how far the means and the logarithms of scales may have moved, and the camera.
template <class AnyCamera>
struct Watch;

template <class T>
struct Watch<Camera<T>> {
  Camera<T> cam;
  T x, y, z;         // the farthest that a mean may have moved in the view
  T wide_x, wide_y;  // px: the deviation on the image of a ball of scale 1 at depth 1 is at most this
  T log_scale;

  GS_HD Watch(const Camera<T>& camera, T mean_reach, T scale_reach) : cam(camera), log_scale(scale_reach) {
    const T ball = mean_reach * T(1.7321);  // over the diagonal
    const T depth = length(cam.row_z);
    x = ball * length(cam.row_x), y = ball * length(cam.row_y), z = ball * depth;
    const T ray_x = larger(magnitude(cam.ray_min_x), magnitude(cam.ray_max_x));
    const T ray_y = larger(magnitude(cam.ray_min_y), magnitude(cam.ray_max_y));
    wide_x = cam.focal_x * (length(cam.row_x) + ray_x * depth);
    wide_y = cam.focal_y * (length(cam.row_y) + ray_y * depth);
  }
};

template <class T>
struct Watch<LensCamera<T>> {
  LensCamera<T> cam;
  T ball;  // the farthest that a mean may have moved in the view
  T wide;  // px: as those of a pinhole, together
  T log_scale;

  GS_HD Watch(const LensCamera<T>& camera, T mean_reach, T scale_reach) : cam(camera), log_scale(scale_reach) {
    const T stretch = std::sqrt(dot(cam.row_x, cam.row_x) + dot(cam.row_y, cam.row_y) + dot(cam.row_z, cam.row_z));
    ball = mean_reach * T(1.7321) * stretch;
    T each = stretch, other = stretch;
    if (cam.lens.chart == Chart::kPerspective) {
      const T depth = length(cam.row_z);
      each = length(cam.row_x) + larger(magnitude(cam.ray_min_x), magnitude(cam.ray_max_x)) * depth;
      other = length(cam.row_y) + larger(magnitude(cam.ray_min_y), magnitude(cam.ray_max_y)) * depth;
    }
    wide = cam.lens.steep * std::sqrt(each * each + other * other);
  }
};

// Whether a deviation on the image is too small to reach it from where the mean is. 3.34 deviations reach alpha 1/255,
// and `radii` count 3. The rest is for rounding.
template <class V>
GS_HD Truth<V> too_far(V away, V variance) {
  const V deviations = (away - 3) / Scalar<V>(3.5);
  return (deviations > 1) & (variance + 1 < deviations * deviations);
}

// Whether a Gaussian certainly has no tile and no radius, wherever within `watch` it has moved. See surely_outside.
template <class T, class V>
GS_HD Truth<V> surely_unseen(const Watch<Camera<T>>& watch, Vec3<V> mean, V largest_scale) {
  const Camera<T>& cam = watch.cam;
  const Vec3<V> view = to_view(cam, mean);
  const V nearest = view.z - watch.z, per_depth = 1 / nearest;
  const V ray_x = view.x / view.z, ray_y = view.y / view.z;
  const V x = cam.mean_focal_x * ray_x + cam.axis_x, y = cam.mean_focal_y * ray_y + cam.axis_y;
  const V moved_x = magnitude(cam.mean_focal_x) * (watch.x + magnitude(ray_x) * watch.z) * per_depth;
  const V moved_y = magnitude(cam.mean_focal_y) * (watch.y + magnitude(ray_y) * watch.z) * per_depth;
  const V away_x = larger<V>(-x, x - T(cam.width + kTile)) - moved_x;
  const V away_y = larger<V>(-y, y - T(cam.height + kTile)) - moved_y;
  const V scale = largest_scale * per_depth;
  const V variance = scale * scale * (watch.wide_x * watch.wide_x + watch.wide_y * watch.wide_y);
  const V farthest = view.z + watch.z;
  return (!in_front(watch.cam, farthest)) |
         (in_front(watch.cam, nearest) & too_far<V>(larger<V>(away_x, away_y), variance));
}

// The least distance from the image, px, of where a lens shows a point of the view that has moved by a ball.
template <class T>
GS_HD T least_away(const LensCamera<T>& cam, Vec3<T> view, T ball, T nearest) {
  const Lens<T>& lens = cam.lens;
  const bool perspective = lens.chart == Chart::kPerspective;
  const OnLens<T> c = on_chart(lens.chart, view);
  const T a = c.value[0], b = c.value[1], r = std::sqrt(a * a + b * b);
  const T moved = ball * (perspective ? 1 + r : T(1)) / nearest, least = r - moved;
  if (!perspective && moved > T(kSleepTurn)) return -1;
  if (least > 0 && least * least > T(1.001) * lens.limit) return T(INFINITY);  // nothing is shown there
  const T into = r > lens.field ? lens.field / r : T(1);  // which brings no two points farther apart
  const Distorted<T> d = distort(lens, into * a, into * b);
  const T x = lens.focal_x * d.value[0] + lens.center_x, y = lens.focal_y * d.value[1] + lens.center_y;
  const T away = outside(cam, x, y) - lens.steep * moved;
  return r + moved > lens.field && lens.beyond < away ? lens.beyond : away;
}

template <class T, class V>
GS_HD Truth<V> surely_unseen(const Watch<LensCamera<T>>& watch, Vec3<V> mean, V largest_scale) {
  const Vec3<V> view = to_view(watch.cam, mean);
  const V depth = depth_of(watch.cam, view), nearest = depth - watch.ball, scale = largest_scale / nearest;
  V away = {};
  if constexpr (kIsScalar<V>)
    away = least_away(watch.cam, view, watch.ball, nearest);
  else
    for (int lane = 0; lane < int(sizeof(V) / sizeof(T)); ++lane)
      away[lane] = least_away(watch.cam, Vec3<T>{view.x[lane], view.y[lane], view.z[lane]}, watch.ball, nearest[lane]);
  const V variance = scale * scale * (watch.wide * watch.wide), farthest = depth + watch.ball;
  return (!in_front(watch.cam, farthest)) | (in_front(watch.cam, nearest) & too_far<V>(away, variance));
}

GS_ISA_END
