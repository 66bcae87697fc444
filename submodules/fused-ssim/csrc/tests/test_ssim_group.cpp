// Four windows at once in double, against one window at a time.
#include <cmath>
#include <random>

#include "gs/check.h"
#include "math/ssim_group.h"

namespace {

using namespace gs::GS_ISA;

std::mt19937 generator(1);

double normal() {
  static std::normal_distribution<double> distribution;
  return distribution(generator);
}

struct Images {
  double x1[kGroupTaps][kGroupTaps], delta[kGroupTaps][kGroupTaps];
};

Images random_images(double base, double spread, double unlike) {
  Images images;
  for (int i = 0; i < kGroupTaps; ++i)
    for (int j = 0; j < kGroupTaps; ++j) {
      images.x1[i][j] = base + spread * normal();
      images.delta[i][j] = unlike * normal();
    }
  return images;
}

// The windows of one row, by either header.
void check_windows(const Images& images, double scale) {
  double means[2][kGroupTaps], vars[2][kGroupTaps];
  Stats<double> columns[kGroupTaps];
  for (int j = 0; j < kGroupTaps; ++j) {
    double x1[kGroupTaps], delta[kGroupTaps];
    for (int i = 0; i < kGroupTaps; ++i) x1[i] = images.x1[i][j], delta[i] = images.delta[i][j];
    const GroupStats<double> stats = stats_of_pixels(x1, delta);
    means[0][j] = stats.sum.mean[0], vars[0][j] = stats.sum.var[0];
    means[1][j] = stats.difference.mean[0], vars[1][j] = stats.difference.var[0];
    columns[j] =
        stats_of_values<double, double>([&](int k) { return Pixel<double>{x1[kRadius + k], delta[kRadius + k]}; });
  }
  const GroupStats<double> stats{moments_of_moments(means[0], vars[0]), moments_of_moments(means[1], vars[1])};
  for (int i = 0; i < kGroup; ++i) {
    const Ssim<double> wanted =
        ssim<double>(stats_of_stats<double, double>([&](int k) { return columns[i + kRadius + k]; }));
    const Pixel<double> anchor{images.x1[kRadius][i], images.delta[kRadius][i]};
    const Unlike<double> got = unlike(stats, i, anchor, scale);
    const Anchored<double>& by_pixel = wanted.by_pixel;
    // Two ways to the same numbers; slopes reach 2 / C2, and the sum of the images doubles the roundings of the first.
    CHECK_NEAR(got.unlike, 1 - wanted.value, 1e-12);
    CHECK_NEAR(got.slope1, scale * by_pixel.slope1, 1e-9 * scale);
    CHECK_NEAR(got.slope_delta, scale * by_pixel.slope_delta, 1e-9 * scale);
    CHECK_NEAR(got.value,
               scale * (by_pixel.value + by_pixel.slope1 * (anchor.x1 - by_pixel.anchor.x1) +
                        by_pixel.slope_delta * (anchor.delta - by_pixel.anchor.delta)),
               1e-9 * scale);
  }
}

// Sums of linear functions with an anchor for each block, for every place of the first of them.
template <int kSize>
void check_gather() {
  constexpr int kCount = 8 + kReach;
  double value[kCount], slope1[kCount], slope_delta[kCount];
  Pixel<double> anchors[kCount];
  for (int i = 0; i < kCount; ++i) {
    value[i] = normal(), slope1[i] = normal(), slope_delta[i] = normal();
    anchors[i] = {normal(), normal()};
  }
  const Pixel<double> about{normal(), normal()};
  for (int first = 0; first < 8; ++first) {
    Gathered<double> wanted{};
    for (int k = -kRadius; k <= kRadius; ++k) {
      const int i = first + kRadius + k;
      const double w = window_weight<double>(std::abs(k));
      const Pixel<double> anchor = anchors[block_of(i, kSize)];
      wanted.value +=
          w * (value[i] + slope1[i] * (about.x1 - anchor.x1) + slope_delta[i] * (about.delta - anchor.delta));
      wanted.slope1 += w * slope1[i];
      wanted.slope_delta += w * slope_delta[i];
    }
    const auto got =
        gather_about<kSize, double>(about, first, value, slope1, slope_delta, [&](int i) { return anchors[i]; });
    CHECK_NEAR(got.value, wanted.value, 1e-14);
    CHECK_NEAR(got.slope1, wanted.slope1, 1e-14);
    CHECK_NEAR(got.slope_delta, wanted.slope_delta, 1e-14);
  }
}

}  // namespace

int main() {
  check_gather<kGroup>();
  check_gather<kBlockRows>();
  for (const double base : {0.0, 0.5, 1.0})
    for (const double spread : {0.0, 1e-6, 1e-2, 0.3})
      for (const double unlike : {0.0, 1e-6, 1e-2, 0.3}) check_windows(random_images(base, spread, unlike), 3);
  return gs::finish_tests("fused-ssim/test_ssim_group");
}
