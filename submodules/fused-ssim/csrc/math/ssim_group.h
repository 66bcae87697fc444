#pragma once
// SSIM and its derivative for four neighbouring windows at once: what GPU threads compute, where ssim.h has one window.
// From sum p = x1 + x2 and difference d = x2 - x1 of the images,
//
//   l = 1 - 2 mean(d)^2 / (mean(p)^2 + mean(d)^2 + 2 C1),   s = 1 - 2 var(d) / (var(p) + var(d) + 2 C2)
//
// so two means and two variances do where ssim.h has five statistics. Value and derivative keep their relative
// precision as the images come to agree, as there.
//
// Four neighbours share an anchor, so that the 14 pixels under their windows are subtracted and squared once, and not
// 44 times. Anchor is the mean of the two middle pixels. With D = sum w_k (x_k - anchor) and Q = sum w_k (x_k -
// anchor)^2, mean = anchor + D and var = Q - D^2. Each window holds both pixels, with weights w and w', so by Cauchy
// and Schwarz D^2 <= (1/w + 1/w') / 4 var <= 3.46 var: the subtraction magnifies rounding at most 4.5 times, less than
// a window that is anchored at its own centre (4.8, see ssim.h).
#include <cmath>

#include "ssim.h"

#ifndef GS_UNROLL
#ifdef __CUDACC__
#define GS_UNROLL _Pragma("unroll")
#else
#define GS_UNROLL
#endif
#endif

GS_ISA_BEGIN

constexpr int kReach = 2 * kRadius;          // pixels that a window has beside its first
constexpr int kGroup = 4;                    // neighbours that share their anchor
constexpr int kGroupTaps = kGroup + kReach;  // pixels under their windows; the first window's centre is number kRadius

// The weighted sum of 11 values.
template <class S>
GS_HD S blur(const S* values) {
  S sum = window_weight<S>(kRadius) * values[0];
  GS_UNROLL
  for (int k = 1; k <= kReach; ++k) sum += window_weight<S>(k < kRadius ? kRadius - k : k - kRadius) * values[k];
  return sum;
}

template <class S>
struct Moments {
  S mean[kGroup], var[kGroup];
};

// Of `deviation` from `anchor`, whose squares may have a variance of their own added.
template <class S>
GS_HD Moments<S> moments(S anchor, const S (&deviation)[kGroupTaps], const S (&square)[kGroupTaps]) {
  Moments<S> all;
  GS_UNROLL
  for (int i = 0; i < kGroup; ++i) {
    const S offset = blur(deviation + i);
    all.mean[i] = anchor + offset;
    all.var[i] = blur(square + i) - offset * offset;
  }
  return all;
}

template <class S>
GS_HD S anchor_of(const S* values) {
  return S(0.5) * (values[kRadius + 1] + values[kRadius + 2]);
}

template <class S>
struct GroupStats {
  Moments<S> sum, difference;
};

// The first pass, over pixels. The sum's deviation is made of the images', so that it is not rounded as the sum is.
template <class S>
GS_HD GroupStats<S> stats_of_pixels(const S* x1, const S* delta) {
  const S anchor1 = anchor_of(x1), anchor_delta = anchor_of(delta);
  S sum[kGroupTaps], difference[kGroupTaps], sum_square[kGroupTaps], difference_square[kGroupTaps];
  GS_UNROLL
  for (int i = 0; i < kGroupTaps; ++i) {
    difference[i] = delta[i] - anchor_delta;
    sum[i] = 2 * (x1[i] - anchor1) + difference[i];
    sum_square[i] = sum[i] * sum[i];
    difference_square[i] = difference[i] * difference[i];
  }
  return {moments(2 * anchor1 + anchor_delta, sum, sum_square), moments(anchor_delta, difference, difference_square)};
}

// The second pass, over the first one's results: variance of the whole = mean of variances + variance of means.
template <class S>
GS_HD Moments<S> moments_of_moments(const S* mean, const S* var) {
  const S anchor = anchor_of(mean);
  S deviation[kGroupTaps], square[kGroupTaps];
  GS_UNROLL
  for (int i = 0; i < kGroupTaps; ++i) {
    deviation[i] = mean[i] - anchor;
    square[i] = deviation[i] * deviation[i] + var[i];
  }
  return moments(anchor, deviation, square);
}

// 1 / x of a denominator, 2e-4 and more. A GPU corrects its own reciprocal, which is biased, by a step of Newton's. Its
// division would spend ten instructions on tiny and huge x.
GS_HD double reciprocal(double x) { return 1 / x; }
GS_HD float reciprocal(float x) {
#if defined(__CUDACC__) && defined(__CUDA_ARCH__)
  float inverse;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(x));
  return std::fma(std::fma(-x, inverse, 1.0f), inverse, inverse);
#else
  return 1 / x;
#endif
}

// One window: 1 - SSIM, and SSIM's derivative by a pixel of the window over the pixel's weight, the linear function
// value + slope1 (x1 - anchor.x1) + slope_delta (delta - anchor.delta).
template <class S>
struct Unlike {
  S unlike, value, slope1, slope_delta;
};

// ssim.h has the derivation. With B1 and B2 the denominators above,
//   dSSIM_q / dx1_p = w 4 (s r (1 + r (mean(p) - mean(d))) + l / B2 ((d - mean(d)) + 2 var(d) / B2 (x1 - mu1)))
// where r = mean(d) / B1 and mean(p) - mean(d) = 2 mu1. `scale` multiplies the derivative.
template <class S>
GS_HD Unlike<S> unlike(const GroupStats<S>& stats, int i, Pixel<S> anchor, S scale) {
  const S mean = stats.sum.mean[i], e = stats.difference.mean[i], var = stats.difference.var[i];
  const S r = e * reciprocal(mean * mean + (e * e + S(2 * kC1)));
  const S inverse2 = reciprocal(stats.sum.var[i] + var + S(2 * kC2));
  const S of_means = 2 * e * r, of_vars = 2 * var * inverse2;  // 1 - l and 1 - s
  const S slope_delta = 4 * scale * inverse2 * (1 - of_means), slope1 = slope_delta * of_vars;
  const S value = 4 * scale * r * (1 - of_vars) * (1 + r * (mean - e));
  const S off_mu1 = S(0.5) * (2 * anchor.x1 - mean + e);
  return {of_means + of_vars - of_means * of_vars, value + slope1 * off_mu1 + slope_delta * (anchor.delta - e), slope1,
          slope_delta};
}

// Windows come in blocks of kBlockRows x kGroup, whose linear functions share an anchor: a mean of pixels around row
// kBlockRow of the first column, near to all of their pixels. So slopes, up to 2 / C2, multiply differences of
// neighbours only, and each block costs one difference.
// Sums of 11 windows, down a column or along a row, begin kRadius windows before a block; window i of these lies in the
// block of this number, if blocks have `size` windows.
constexpr int kBlockRows = 8, kBlockRow = 4;
GS_HD constexpr int block_of(int window, int size) { return (window + kBlockRows - kRadius) / size; }
static_assert(kBlockRows % kGroup == 0 && kBlockRow <= kRadius && kBlockRows - kBlockRow <= kRadius);

// A sum of windows' linear functions times their weights.
template <class S>
struct Gathered {
  S value, slope1, slope_delta;
};

// Sums 11 windows from number `first` on, anchored at `about`. `anchor(i)` is that of block i. The far blocks, with the
// smallest weights, come first: most roundings are of small sums.
template <int kSize, class S, class Anchor>
GS_HD Gathered<S> gather_about(Pixel<S> about, int first, const S* value, const S* slope1, const S* slope_delta,
                               const Anchor& anchor) {
  constexpr int kBlocks = kReach / kSize + 2;  // at most
  const int begin = block_of(first, kSize), centre = block_of(first + kRadius, kSize) - begin;
  Gathered<S> blocks[kBlocks] = {};
  GS_UNROLL
  for (int k = 0; k <= kReach; ++k) {
    const S w = window_weight<S>(k < kRadius ? kRadius - k : k - kRadius);
    Gathered<S>& block = blocks[block_of(first + k, kSize) - begin];
    block.slope1 += w * slope1[first + k];
    block.slope_delta += w * slope_delta[first + k];
  }
  Gathered<S> all{};
  GS_UNROLL
  for (int distance = kBlocks - 1; distance >= 0; --distance) {
    GS_UNROLL
    for (int i = 0; i <= block_of(first + kReach, kSize) - begin; ++i) {
      if (i - centre != distance && centre - i != distance) continue;
      const Pixel<S> from = anchor(begin + i);
      all.value += blocks[i].slope1 * (about.x1 - from.x1) + blocks[i].slope_delta * (about.delta - from.delta);
      all.slope1 += blocks[i].slope1;
      all.slope_delta += blocks[i].slope_delta;
    }
  }
  all.value += blur(value + first);
  return all;
}

GS_ISA_END
