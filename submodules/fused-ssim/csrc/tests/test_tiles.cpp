// The tiled loops under the address sanitizer, at sizes around those where tiles begin: bits do not depend on threads,
// nor on whether a gradient is wanted.
#include <cmath>
#include <random>
#include <vector>

#include "backend.h"
#include "gs/check.h"
#include "gs/check_threads.h"

namespace {

struct Result {
  double l1 = 0, ssim = 0;
  std::vector<double> gradient;
};

Result run(const gs::ImagePair<double>& images, bool valid, bool gradient, const gs::Executor& executor) {
  Result out;
  if (gradient) out.gradient.assign(images.planes * images.height * images.width, NAN);
  gs::GS_ISA::l1_ssim_cpu({images, valid, &out.l1, &out.ssim, gradient ? out.gradient.data() : nullptr}, executor);
  return out;
}

void check_size(int64_t planes, int64_t height, int64_t width, bool valid) {
  std::mt19937 random(height * 10000 + width);
  std::uniform_real_distribution<double> uniform;
  std::vector<double> x1(planes * height * width), x2(x1.size());
  for (double& x : x1) x = uniform(random);
  for (double& x : x2) x = uniform(random);
  const gs::ImagePair<double> images{x1.data(), x2.data(), false, planes, height, width};
  const Result serial = run(images, valid, true, gs::serial_executor());
  for (const double x : serial.gradient) CHECK(std::isfinite(x));
  const Result threaded = run(images, valid, true, gs::three_threads());
  CHECK(threaded.l1 == serial.l1 && threaded.ssim == serial.ssim && threaded.gradient == serial.gradient);
  const Result plain = run(images, valid, false, gs::serial_executor());  // other margins of the tiles
  CHECK(plain.l1 == serial.l1 && plain.ssim == serial.ssim);
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
