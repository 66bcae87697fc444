// The small functions: exp2, activations, sums of lanes.
#include <limits>
#include <random>
#include <vector>

#include "gs/check.h"
#include "gs/lane_halves.h"
#include "gs/simd.h"
#include "math/activation.h"
#include "math/exp2.h"

using namespace gs::GS_ISA;

namespace {

std::mt19937 generator(1);
double normal() { return std::normal_distribution<double>()(generator); }

// Largest relative error of exp2_lanes on steps over the range that blending uses and beyond, up to |t| = 120.
template <class T>
double exp2_error() {
  using S = Simd<T>;
  double worst = 0;
  T t[S::kLanes], got[S::kLanes];
  for (double first = -119.9; first < 119; first += 0.0137) {
    for (int i = 0; i < S::kLanes; ++i) t[i] = T(first + 0.001 * i);
    S::store(got, exp2_lanes<typename S::Vec, typename S::Mask>(S::load(t), T()));
    for (int i = 0; i < S::kLanes; ++i)
      worst = std::max<double>(worst, std::abs(double((long double)got[i] / std::exp2((long double)t[i]) - 1)));
  }
  return worst;
}

void test_exp2() {
  // Rounding of the polynomial's steps: a bound of twice the unit in the last place, 1.2e-7 and 2.2e-16, has room.
  CHECK(exp2_error<float>() < 2.4e-7);
  CHECK(exp2_error<double>() < 4.5e-16);
}

// The sums of several vectors are those of the same tree on one vector, and turning the lanes changes none.
template <class T>
void test_lane_sums() {
  using S = Simd<T>;
  constexpr int kCount = 10;
  typename S::Vec v[kCount], turned[kCount];
  T got[kCount], got_turned[kCount];
  for (int turn = 0; turn < S::kLanes; ++turn) {
    for (int k = 0; k < kCount; ++k)
      for (int i = 0; i < S::kLanes; ++i) v[k][i] = turned[k][(i + turn) % S::kLanes] = T(normal());
    LaneSums<T, kVectorBytes>::store(v, got);
    LaneSums<T, kVectorBytes>::store(turned, got_turned);
    for (int k = 0; k < kCount; ++k) {
      T tree[S::kLanes];
      S::store(tree, v[k]);
      for (int half = S::kLanes / 2; half; half /= 2)
        for (int i = 0; i < half; ++i) tree[i] += tree[i + half];
      CHECK(got[k] == tree[0] && got_turned[k] == tree[0]);
    }
  }
}

template <class T>
void test_sigmoid() {
  const double unit = std::numeric_limits<T>::epsilon();
  for (double x = -80; x <= 80; x += 0.37) {
    const long double logit = T(x), log2_e = 1.4426950408889634074L;
    const long double wanted = -std::log1p(std::exp(-logit)) * log2_e;
    // Relative, so that opacities near 1 keep their distance from it.
    CHECK_NEAR(log2_sigmoid(T(x)) / double(wanted), 1, 4 * unit);
    CHECK_NEAR(log_sigmoid_slope(T(x)) * double(1 + std::exp(logit)), 1, 4 * unit);
  }
  CHECK(log2_sigmoid(std::numeric_limits<T>::infinity()) == 0);
  CHECK(log2_sigmoid(-std::numeric_limits<T>::infinity()) == -std::numeric_limits<T>::infinity());
  CHECK(std::isnan(log2_sigmoid(std::numeric_limits<T>::quiet_NaN())));
}

// A function on a step over [first, last], alone and in a vector: the same bits, and within `units` of the last place.
template <class T, class Function, class Exact>
void check_function(double first, double last, double step, double units, const Function& function,
                    const Exact& exact) {
  using S = Simd<T>;
  T x[S::kLanes], got[S::kLanes];
  double worst = 0;
  for (double at = first; at <= last; at += step * S::kLanes) {
    for (int i = 0; i < S::kLanes; ++i) x[i] = T(std::min(at + step * i, last));
    S::store(got, function(S::load(x)));
    for (int i = 0; i < S::kLanes; ++i) {
      const T alone = function(x[i]);
      CHECK(alone == got[i]);
      const long double wanted = exact((long double)x[i]);
      const double unit = std::max<double>(std::numeric_limits<T>::denorm_min(),
                                           std::abs(double(wanted)) * std::numeric_limits<T>::epsilon());
      worst = std::max(worst, std::abs(double(got[i] - wanted)) / unit);
    }
  }
  CHECK(worst < units);
}

template <class T>
void test_exponential() {
  using V = typename Simd<T>::Vec;
  const auto exact_exp = [](long double x) { return std::exp(x); };
  const auto exact_log = [](long double x) { return std::log1p(x); };
  const auto power = [](auto x) { return exponential(x); };
  const auto log = [](auto x) { return log_one_plus(x); };
  check_function<T>(-103, 88, 0.00137, 1, power, exact_exp);  // below -87.4, floats are not normal
  check_function<T>(-1e-3, 1e-3, 1e-7, 1, power, exact_exp);
  check_function<T>(0, 1, 1.7e-5, 1, log, exact_log);
  check_function<T>(0, 1e-6, 1.7e-10, 1, log, exact_log);
  const T infinity = std::numeric_limits<T>::infinity();
  for (const T far : {T(1000), infinity, std::numeric_limits<T>::max()}) {
    CHECK(exponential(far) == infinity && exponential(V{} + far)[0] == infinity);
    CHECK(exponential(-far) == 0 && exponential(V{} - far)[0] == 0);
  }
  const T nan = std::numeric_limits<T>::quiet_NaN();
  CHECK(std::isnan(exponential(nan)) && std::isnan(exponential(V{} + nan)[0]));
  CHECK(std::isnan(log_one_plus(nan)) && std::isnan(log_one_plus(V{} + nan)[0]));
}

}  // namespace

int main() {
  test_exp2();
  test_lane_sums<float>(), test_lane_sums<double>();
  test_exponential<float>(), test_exponential<double>();
  test_sigmoid<float>(), test_sigmoid<double>();
  return gs::finish_tests("rasterizer functions");
}
