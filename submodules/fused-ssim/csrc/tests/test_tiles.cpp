// The tiled loops, under the address sanitizer, at sizes around those where tiles begin, against single windows.
#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

#include "backend.h"
#include "gs/check.h"
#include "gs/check_threads.h"
#include "math/ssim.h"

namespace {

using gs::GS_ISA::kRadius;

struct Image {
  int64_t height, width;
  std::vector<double> x1, x2;
  double at(const std::vector<double>& image, int64_t i, int64_t j) const {
    return i >= 0 && i < height && j >= 0 && j < width ? image[i * width + j] : 0;
  }
};

// Returns SSIM of the window at (i, j), and adds `scale` times its derivative by the pixels of img1 to `gradient`.
double window(const Image& image, int64_t i, int64_t j, double scale, std::vector<double>& gradient) {
  using namespace gs::GS_ISA;
  const auto pixel = [&](int64_t y, int64_t x) {
    const double x1 = image.at(image.x1, y, x);
    return Pixel<double>{x1, image.at(image.x2, y, x) - x1};
  };
  const auto column = [&](int k) {
    return stats_of_values<double, double>([&](int m) { return pixel(i + m, j + k); });
  };
  const auto result = ssim<double>(stats_of_stats<double, double>(column));
  for (int64_t y = std::max<int64_t>(i - kRadius, 0); y <= std::min(i + kRadius, image.height - 1); ++y)
    for (int64_t x = std::max<int64_t>(j - kRadius, 0); x <= std::min(j + kRadius, image.width - 1); ++x) {
      const Anchored<double>& by = result.by_pixel;
      const Pixel<double> p = pixel(y, x);
      gradient[y * image.width + x] +=
          scale * window_weight<double>(std::abs(int(y - i))) * window_weight<double>(std::abs(int(x - j))) *
          (by.value + by.slope1 * (p.x1 - by.anchor.x1) + by.slope_delta * (p.delta - by.anchor.delta));
    }
  return result.value;
}

void check_size(int64_t planes, int64_t height, int64_t width, bool valid) {
  std::mt19937 random(height * 10000 + width);
  std::uniform_real_distribution<double> uniform;
  std::vector<double> x1(planes * height * width), x2(x1.size()), wanted(x1.size());
  for (double& x : x1) x = uniform(random);
  for (double& x : x2) x = uniform(random);
  const int64_t rim = valid ? kRadius : 0;
  const double count = double(planes * (height - 2 * rim) * (width - 2 * rim));
  double l1 = 0, ssim = 0, largest = 0;
  for (int64_t plane = 0; plane < planes; ++plane) {
    const int64_t begin = plane * height * width, end = begin + height * width;
    const Image image{
        height, width, {&x1[begin], &x1[begin] + height * width}, {&x2[begin], &x2[begin] + height * width}};
    std::vector<double> gradient(height * width);
    for (int64_t i = rim; i < height - rim; ++i)
      for (int64_t j = rim; j < width - rim; ++j) ssim += window(image, i, j, 1 / count, gradient) / count;
    for (int64_t i = begin; i < end; ++i) {
      l1 += std::abs(x1[i] - x2[i]) / x1.size();
      wanted[i] = gradient[i - begin];
      largest = std::max(largest, std::abs(wanted[i]));
    }
  }

  double got_l1 = 0, got_ssim = 0;
  std::vector<double> got(x1.size(), NAN), threaded(x1.size(), NAN);
  gs::L1Ssim<double> args{{x1.data(), x2.data(), false, planes, height, width}, valid, &got_l1, &got_ssim, got.data()};
  gs::GS_ISA::l1_ssim_cpu(args, gs::serial_executor());
  // Sums of hundreds of doubles in another order.
  CHECK_NEAR(got_l1, l1, 1e-13);
  CHECK_NEAR(got_ssim, ssim, 1e-13);
  for (size_t i = 0; i < got.size(); ++i) CHECK_NEAR(got[i], wanted[i], 1e-13 * largest);

  const double kept_l1 = got_l1, kept_ssim = got_ssim;
  args.gradient = threaded.data();
  gs::GS_ISA::l1_ssim_cpu(args, gs::three_threads());
  CHECK(got_l1 == kept_l1 && got_ssim == kept_ssim && got == threaded);
  args.gradient = nullptr;  // other margins of the tiles must give the same value
  gs::GS_ISA::l1_ssim_cpu(args, gs::serial_executor());
  CHECK(got_l1 == kept_l1 && got_ssim == kept_ssim);
}

}  // namespace

int main() {
  const int64_t tile = 2048 / sizeof(double);
  for (const int64_t height : {1, 2, 5, 10, 31, 32, 33, 65})
    for (const int64_t width : {1, 2, 4, 9, 11, 17}) check_size(2, height, width, false);
  for (const int64_t width : {tile - 1, tile, tile + 1, 2 * tile + 1}) {
    check_size(1, 3, width, false);
    check_size(1, 12, width, true);
  }
  for (const int64_t height : {11, 12, 21, 31, 32, 33, 65})
    for (const int64_t width : {11, 12, 21}) check_size(2, height, width, true);
  return gs::finish_tests("fused-ssim/test_tiles");
}
