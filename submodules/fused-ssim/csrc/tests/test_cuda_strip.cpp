// The work of the CUDA kernel's threads between two barriers, run one after the other on the host, against the CPU
// backend.
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <random>
#include <vector>

#include "backend.h"
#include "cuda/ssim_strip.h"
#include "gs/check.h"

namespace {

using namespace gs::GS_ISA;

bool last_thread_first = false;

template <class Phase>
void all_threads(const Phase& phase) {
  for (int i = 0; i < kThreads; ++i) phase(last_thread_first ? kThreads - 1 - i : i);
}

struct Result {
  double l1 = 0, ssim = 0;
  std::vector<float> gradient;
};

template <bool kGradient, class Source>
Result run_kernel(const Cut& cut, int64_t planes, int64_t height, int64_t width, bool valid,
                  const std::vector<float>& img1, const std::vector<Source>& img2, bool clamp) {
  const double rim = valid ? kReach : 0;
  const double ssim_count = double(planes) * (height - rim) * (width - rim);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  Result result;
  result.gradient.assign(img1.size(), nan);  // shows pixels that are not written
  const auto strip = std::make_unique<Strip>();
  std::vector<Rows> rows(kThreads);
  for (int64_t block = 0; block < cut.parts; ++block) {
    std::fill_n(reinterpret_cast<float*>(strip.get()), sizeof(Strip) / sizeof(float),
                nan);  // shows values that are not set
    const Part part = part_of(cut, height, width, valid, block);
    const int64_t plane = block / (cut.across * cut.down(height)) * height * width;
    const float* plane1 = &img1[plane];
    const Source* plane2 = &img2[plane];
    Sums sums{};
    for (int first = 0; first < kRing; first += kStep)
      all_threads(
          [&](int t) { put(*strip, part, load(part, plane1, plane2, clamp, first, t), first, kRing, t, sums); });
    for (int step = 0; step < step_count(part.rows); ++step) {
      all_threads([&](int t) { column_stats(*strip, step, t); });
      all_threads([&](int t) { window_row<kGradient>(*strip, part, step, t, sums); });
      if (kGradient) all_threads([&](int t) { gather_down(*strip, step, t); });
      const int next = step * kStep + kRing;
      all_threads([&](int t) { rows[t] = load(part, plane1, plane2, clamp, next, t); });
      if (kGradient) all_threads([&](int t) { gather_across(*strip, t); });
      all_threads([&](int t) { put(*strip, part, rows[t], next, next + kStep, t, sums); });
      if (kGradient)
        all_threads([&](int t) {
          write_gradient(*strip, part, step, float(1 / ssim_count), result.gradient.data() + plane, t);
        });
    }
    result.l1 += sums.l1 / double(img1.size());
    result.ssim += sums.ssim / ssim_count;
  }
  return result;
}

template <class Source>
void check(int steps, int64_t planes, int64_t height, int64_t width, bool valid, bool clamp = false) {
  const Cut cut = Cut::with_steps(steps, planes, height, width);
  std::mt19937 random(unsigned(height * 10000 + width));
  std::uniform_real_distribution<float> uniform, wide(-0.5f, 1.5f);
  std::vector<float> img1(planes * height * width), wanted(img1.size());
  std::vector<Source> img2(img1.size());
  for (float& x : img1) x = clamp ? wide(random) : uniform(random);
  for (Source& x : img2) x = Source(sizeof(Source) == 1 ? 255 * uniform(random) : uniform(random));

  double l1 = 0, ssim = 0;
  gs::GS_ISA::l1_ssim_cpu(
      {{img1.data(), img2.data(), sizeof(Source) == 1, planes, height, width, clamp}, valid, &l1, &ssim, wanted.data()},
      gs::serial_executor());
  const Result got = run_kernel<true>(cut, planes, height, width, valid, img1, img2, clamp);
  // The same floats, except for fused multiply-adds of the compiler; sums of doubles in another order.
  CHECK_NEAR(got.l1, l1, 1e-12);
  CHECK_NEAR(got.ssim, ssim, 4 * 6e-8);
  float largest = 0;
  for (float x : wanted) largest = std::max(largest, std::abs(x));
  for (size_t i = 0; i < wanted.size(); ++i) CHECK_NEAR(got.gradient[i], wanted[i], 40 * 6e-8 * largest);

  last_thread_first = true;  // shows a thread that needs another's result of the same phase
  CHECK(run_kernel<true>(cut, planes, height, width, valid, img1, img2, clamp).gradient == got.gradient);
  last_thread_first = false;
  const Result plain = run_kernel<false>(cut, planes, height, width, valid, img1, img2, clamp);
  CHECK(plain.l1 == got.l1 && plain.ssim == got.ssim);
}

void check_cut() {
  CHECK(Cut::of(3, 1060, 1600).rows == 70 && Cut::of(3, 1060, 1600).parts == 3 * 15 * 16);
  CHECK(Cut::of(3, 800, 800).rows == 38);
  CHECK(Cut::of(1, 1, 1).rows == 22 && Cut::of(1, 1, 1).parts == 1);
}

}  // namespace

int main() {
  check_cut();
  // Sizes around the ends of parts, steps and the strip's width.
  for (const int64_t height : {1, 2, 5, 21, 22, 23, 45})
    for (const int64_t width : {1, 4, 11, 107, 108, 109}) check<float>(8, 1, height, width, false);
  for (const int64_t width : {213, 216, 217, 230}) check<float>(8, 2, 13, width, true);
  for (const int64_t height : {11, 12, 22, 23, 32, 33}) check<uint8_t>(8, 2, height, 15, true);
  check<uint8_t>(8, 3, 9, 130, false);
  check<uint8_t>(8, 1, 45, 109, false, true);
  for (const int steps : {12, 20}) check<float>(steps, 1, 150, 112, true);
  return gs::finish_tests("fused-ssim/test_cuda_strip");
}
