#pragma once
// SSIM of two images and its derivative by the first, for one pixel (Wang, Bovik, Sheikh and Simoncelli 2004, eq. 13):
//
//   SSIM = l s,   l = (2 mu1 mu2 + C1) / (mu1^2 + mu2^2 + C1),   s = (2 cov + C2) / (var1 + var2 + C2)
//
// with mean, variance and covariance under an 11 x 11 Gaussian of sigma 1.5, computed as 11 taps down, then 11 across.
// Everything comes from x1 and the difference x2 - x1, called delta. With e = mean of delta,
//
//   l = 1 - e^2 / (mu1^2 + mu2^2 + C1),   s = 1 - var(delta) / (var1 + var2 + C2)
//
// so that value and derivative keep their relative precision as the images come to agree.
// S is the scalar (float, double), V the scalar or a vector of it, `at` a function of the offset k in [-5, 5].
#include "gs/hd.h"
#include "gs/isa.h"

GS_ISA_BEGIN

constexpr int kRadius = 5;
constexpr double kC1 = 0.01 * 0.01, kC2 = 0.03 * 0.03;  // (0.01 L)^2 and (0.03 L)^2 of the paper, L = 1

// exp(-k^2 / (2 * 1.5^2)), normalised to sum 1 over the 11 taps; k in [0, 5].
template <class S>
GS_HD constexpr S window_weight(int k) {
  constexpr double weights[kRadius + 1] = {0.2660117248617943,  0.21300553771125366,  0.1093606895097,
                                           0.03600077212843082, 0.007598758135239184, 0.0010283800844791099};
  return S(weights[k]);
}

// The same pixel of the first image and of the difference.
template <class V>
struct Pixel {
  V x1, delta;
};

template <class V>
struct Stats {
  V mu1, mu_delta, var1, var_delta, cov;  // cov: of x1 and delta
};

// The first pass, over values. With d_k = x_k - x_0, D = sum w_k d_k and Q = sum w_k d_k^2: mean = x_0 + D, var = Q -
// D^2. The centre's own share of the variance is w_0 D^2, so Q = var + D^2 <= (1 + 1/w_0) var = 4.8 var. However bright
// the image, the subtraction magnifies rounding at most 4.8 times, and var is never negative. The same holds for cov
// against sqrt(var1 var_delta). The textbook's E[x^2] - mu^2 has no such bound.
template <class S, class V, class At>
GS_HD Stats<V> stats_of_values(const At& at) {
  const Pixel<V> centre = at(0);
  V d1{}, dd{}, q1{}, qd{}, q1d{};
  for (int k = 1; k <= kRadius; ++k) {
    const S w = window_weight<S>(k);
    const Pixel<V> before = at(-k), after = at(k);
    const V a1 = before.x1 - centre.x1, b1 = after.x1 - centre.x1;
    const V ad = before.delta - centre.delta, bd = after.delta - centre.delta;
    d1 += w * (a1 + b1);
    dd += w * (ad + bd);
    q1 += w * (a1 * a1 + b1 * b1);
    qd += w * (ad * ad + bd * bd);
    q1d += w * (a1 * ad + b1 * bd);
  }
  return {centre.x1 + d1, centre.delta + dd, q1 - d1 * d1, qd - dd * dd, q1d - d1 * dd};
}

// The second pass, over the first one's results. By the law of total variance, the variance of the whole window = mean
// of the columns' variances + variance of the columns' means.
template <class S, class V, class At>
GS_HD Stats<V> stats_of_stats(const At& at) {
  Stats<V> all = stats_of_values<S, V>([&](int k) {
    const Stats<V> one = at(k);
    return Pixel<V>{one.mu1, one.mu_delta};
  });
  for (int k = -kRadius; k <= kRadius; ++k) {
    const S w = window_weight<S>(k < 0 ? -k : k);
    const Stats<V> one = at(k);
    all.var1 += w * one.var1;
    all.var_delta += w * one.var_delta;
    all.cov += w * one.cov;
  }
  return all;
}

// The linear function value + slope1 (x1 - anchor.x1) + slope_delta (delta - anchor.delta) of a pixel.
template <class V>
struct Anchored {
  V value, slope1, slope_delta;
  Pixel<V> anchor;
};

template <class V>
struct Ssim {
  V value;
  Anchored<V> by_pixel;  // times the window's weight it is the derivative of `value` by a pixel x1 of the window
};

// Of window q, pixel p's share of mu1, var1 and cov12 has the derivatives w, 2 w (x1 - mu1) and w (x2 - mu2) by x1, so
//   dSSIM_q / dx1_p = w (2 s (mu2 - mu1 l) / B1 + (2 l / B2) ((x2 - mu2) - s (x1 - mu1)))     (B: the denominators).
// Here mu2 - mu1 l = e (1 + mu1 e / B1), and (x2 - mu2) - s (x1 - mu1) = (delta - e) + var(delta) / B2 (x1 - mu1).
template <class S, class V>
GS_HD Ssim<V> ssim(const Stats<V>& q) {
  const S c1 = S(kC1), c2 = S(kC2), one = 1, two = 2;
  const V mu2 = q.mu1 + q.mu_delta;
  const V r = q.mu_delta / (q.mu1 * q.mu1 + mu2 * mu2 + c1);
  const V inverse2 = one / (two * (q.var1 + q.cov) + q.var_delta + c2);  // var2 = var1 + 2 cov + var_delta
  const V l = one - q.mu_delta * r;
  const V unlike = q.var_delta * inverse2;
  const V s = one - unlike;
  const V slope_delta = two * l * inverse2;
  return {l * s, {two * s * r * (one + q.mu1 * r), slope_delta * unlike, slope_delta, {q.mu1, q.mu_delta}}};
}

// The sum of w_k at(k), anchored at `anchor`. The derivative at a pixel is this sum over the windows that hold it. It
// is taken down first, anchored at the pixel of the same row in each column; then across, anchored at the pixel itself,
// where `value` is the sum. The slopes reach 2 / C2 and multiply differences of neighbours only; the textbook's
// x1 sum(w a) - sum(w mu1 a) cancels.
template <class S, class V, class At>
GS_HD Anchored<V> gather(const At& at, const Pixel<V>& anchor) {
  Anchored<V> sum{V{}, V{}, V{}, anchor};
  for (int k = -kRadius; k <= kRadius; ++k) {
    const S w = window_weight<S>(k < 0 ? -k : k);
    const Anchored<V> one = at(k);
    sum.value += w * (one.value + one.slope1 * (anchor.x1 - one.anchor.x1) +
                      one.slope_delta * (anchor.delta - one.anchor.delta));
    sum.slope1 += w * one.slope1;
    sum.slope_delta += w * one.slope_delta;
  }
  return sum;
}

// x clamped to [0, 1], and whether its derivative there is 1 and not 0. As in torch, NaN stays NaN and gets no
// gradient.
template <class S>
GS_HD S clamp_to_unit(S x) {
  return x < 0 ? S(0) : x > 1 ? S(1) : x;
}
template <class S>
GS_HD bool in_unit(S x) {
  return x >= 0 && x <= 1;
}

// The derivative of |x2 - x1| by x1; 0 where they are equal, as in torch.
template <class V>
GS_HD V abs_difference_vjp(V x1, V x2) {
  return V(x1 > x2) - V(x1 < x2);
}

GS_ISA_END
