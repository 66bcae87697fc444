// One window in double: the statistics against two walks in long double, the derivative against central differences.
#include <cmath>
#include <limits>
#include <random>
#include <vector>

#include "gs/check.h"
#include "math/ssim.h"

namespace {

using gs::GS_ISA::kRadius;
constexpr int kSide = 2 * kRadius + 1;

struct Window {
  double x1[kSide][kSide], x2[kSide][kSide];
};

gs::GS_ISA::Stats<double> stats(const Window& window) {
  using namespace gs::GS_ISA;
  const auto column = [&](int j) {
    return stats_of_values<double, double>([&](int i) {
      const double x1 = window.x1[kRadius + i][kRadius + j];
      return Pixel<double>{x1, window.x2[kRadius + i][kRadius + j] - x1};
    });
  };
  return stats_of_stats<double, double>(column);
}

gs::GS_ISA::Ssim<double> ssim(const Window& window) { return gs::GS_ISA::ssim<double>(stats(window)); }

Window random_window(double base, double spread, double unlike) {
  static std::mt19937 random(1);
  std::normal_distribution<double> normal;
  Window window;
  for (int i = 0; i < kSide; ++i)
    for (int j = 0; j < kSide; ++j) {
      window.x1[i][j] = base + spread * normal(random);
      window.x2[i][j] = window.x1[i][j] + unlike * normal(random);
    }
  return window;
}

void check_weights() {
  double sum = 0;
  for (int k = -kRadius; k <= kRadius; ++k) sum += std::exp(-k * k / 4.5);
  // 17 digits name a double; exp and the division round.
  for (int k = 0; k <= kRadius; ++k)
    CHECK_NEAR(gs::GS_ISA::window_weight<double>(k), std::exp(-k * k / 4.5) / sum, 1e-16);
}

void check_stats(const Window& window) {
  if (!gs::kLongDoubleIsWider) return;
  const gs::GS_ISA::Stats<double> got = stats(window);
  long double mean[2] = {}, var[2] = {}, cov = 0, weights = 0;
  const auto walk = [&](const auto& visit) {
    for (int i = -kRadius; i <= kRadius; ++i)
      for (int j = -kRadius; j <= kRadius; ++j) {
        const double x1 = window.x1[kRadius + i][kRadius + j], x2 = window.x2[kRadius + i][kRadius + j];
        visit(std::exp(-(i * i + j * j) / 4.5L), x1, x2 - x1);
      }
  };
  walk([&](long double w, double x1, double delta) {
    weights += w;
    mean[0] += w * x1;
    mean[1] += w * delta;
  });
  for (long double& m : mean) m /= weights;
  walk([&](long double w, double x1, double delta) {
    w /= weights;
    var[0] += w * (x1 - mean[0]) * (x1 - mean[0]);
    var[1] += w * (delta - mean[1]) * (delta - mean[1]);
    cov += w * (x1 - mean[0]) * (delta - mean[1]);
  });
  // Two passes of some ten operations, magnified at most 4.8 times each (ssim.h). The column means add their own
  // rounding, relative to the mean, times twice the deviation.
  const double eps = std::numeric_limits<double>::epsilon(), of_var = 2 * 4.8 * 10 * eps;
  const double sd1 = std::sqrt(var[0]), sd_delta = std::sqrt(var[1]);
  const double of_mean1 = eps * std::abs(mean[0]), of_mean_delta = eps * std::abs(mean[1]);
  // A mean is the centre plus a mean of differences from it, both of which may be larger than their sum.
  CHECK_NEAR(got.mu1, mean[0], 10 * eps * (std::abs(mean[0]) + sd1));
  CHECK_NEAR(got.mu_delta, mean[1], 10 * eps * (std::abs(mean[1]) + sd_delta));
  CHECK_NEAR(got.var1, var[0], of_var * var[0] + 2 * sd1 * of_mean1 + of_mean1 * of_mean1);
  CHECK_NEAR(got.var_delta, var[1], of_var * var[1] + 2 * sd_delta * of_mean_delta + of_mean_delta * of_mean_delta);
  CHECK_NEAR(got.cov, cov, of_var * sd1 * sd_delta + sd1 * of_mean_delta + (sd_delta + of_mean_delta) * of_mean1);
  CHECK(got.var1 >= 0 && got.var_delta >= 0);
}

void check_derivative(Window window) {
  using gs::GS_ISA::window_weight;
  const gs::GS_ISA::Anchored<double> by_pixel = ssim(window).by_pixel;
  const double step = 1e-5;
  for (int i = 0; i < kSide; ++i)
    for (int j = 0; j < kSide; ++j) {
      double& x1 = window.x1[i][j];
      const double kept = x1, delta = window.x2[i][j] - x1;
      const double w = window_weight<double>(std::abs(i - kRadius)) * window_weight<double>(std::abs(j - kRadius));
      const double got = w * (by_pixel.value + by_pixel.slope1 * (x1 - by_pixel.anchor.x1) +
                              by_pixel.slope_delta * (delta - by_pixel.anchor.delta));
      x1 = kept + step;
      const double above = ssim(window).value;
      x1 = kept - step;
      const double below = ssim(window).value;
      x1 = kept;
      // Third derivative at most (w / C2)^1.5 or so: 1e-10 * 4e4 / 6 at the centre; rounding of the values: 1e-16 /
      // step.
      CHECK_NEAR(got, (above - below) / (2 * step), 1e-6 * w + 2e-11);
    }
}

// Down, then across, must give the same as one sum over all windows that hold the pixel.
void check_gather() {
  using namespace gs::GS_ISA;
  static Anchored<double> maps[kSide][kSide];
  Pixel<double> image[kSide];  // the row of the pixel
  std::mt19937 random(2);
  std::normal_distribution<double> normal;
  for (auto& row : maps)
    for (auto& map : row) map = {normal(random), normal(random), normal(random), {normal(random), normal(random)}};
  for (auto& pixel : image) pixel = {normal(random), normal(random)};
  const Pixel<double> centre = image[kRadius];
  double wanted = 0;
  for (int i = -kRadius; i <= kRadius; ++i)
    for (int j = -kRadius; j <= kRadius; ++j) {
      const auto& map = maps[kRadius + i][kRadius + j];
      wanted +=
          window_weight<double>(std::abs(i)) * window_weight<double>(std::abs(j)) *
          (map.value + map.slope1 * (centre.x1 - map.anchor.x1) + map.slope_delta * (centre.delta - map.anchor.delta));
    }
  const auto down = [&](int j) {
    return gather<double>([&](int i) { return maps[kRadius + i][kRadius + j]; }, image[kRadius + j]);
  };
  CHECK_NEAR(gather<double>(down, centre).value, wanted, 1e-14);  // a few hundred roundings of numbers about 1
}

}  // namespace

int main() {
  check_weights();
  check_gather();
  for (const double base : {0.0, 0.5, 1.0, 1000.0})
    for (const double spread : {0.0, 1e-6, 1e-2, 0.3})
      for (const double unlike : {0.0, 1e-6, 1e-2, 0.3}) check_stats(random_window(base, spread, unlike));
  for (const double base : {0.0, 0.5, 1.0})
    for (const double spread : {1e-2, 0.3})
      for (const double unlike : {1e-3, 0.3}) check_derivative(random_window(base, spread, unlike));
  const Window same = random_window(1, 0.01, 0);
  CHECK(ssim(same).value == 1);
  CHECK(ssim(same).by_pixel.value == 0 && ssim(same).by_pixel.slope1 == 0);
  return gs::finish_tests("fused-ssim/test_ssim");
}
