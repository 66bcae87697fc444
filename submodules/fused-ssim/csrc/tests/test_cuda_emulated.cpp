// The CUDA kernels on the CPU (submodules/common/emulation), under the sanitizers, against the CPU backend, in several
// orders of the threads.
#include <cmath>
#include <random>
#include <vector>

#include "backend.h"
#include "cuda/ssim_tile.h"
#include "emulated_queue.h"
#include "gs/check.h"

namespace {

struct Result {
  float l1 = -1, ssim = -1, loss = -1;
  std::vector<float> maps, vjp;
};

template <class Source>
void check(int64_t planes, int64_t height, int64_t width, bool valid, bool clamp = false, int orders = 3) {
  std::mt19937 random(unsigned(height * 1000 + width));
  std::uniform_real_distribution<float> uniform, wide(-0.5f, 1.5f);
  std::vector<float> img1(planes * height * width);
  std::vector<Source> img2(img1.size());
  for (float& x : img1) x = clamp ? wide(random) : uniform(random);
  for (Source& x : img2) x = Source(sizeof(Source) == 1 ? 255 * uniform(random) : uniform(random));
  const gs::ImagePair<float> images = {img1.data(), img2.data(), sizeof(Source) == 1, planes, height, width, clamp};

  double l1, ssim;
  std::vector<float> gradient(img1.size()), vjp(img1.size());
  gs::GS_ISA::l1_ssim_cpu({images, valid, &l1, &ssim, gradient.data()}, gs::serial_executor());
  const float grad_l1 = 0.7f, grad_ssim = -1.3f;
  gs::GS_ISA::l1_ssim_vjp_cpu({images, gradient.data(), grad_l1, grad_ssim, vjp.data()}, gs::serial_executor());
  double largest = 0;
  for (float x : gradient) largest = std::max(largest, double(std::abs(x)));

  Result first;
  for (const auto order : gs::emulation::kOrders) {
    if (orders-- == 0) break;
    gs::emulation::order = order;
    gs::emulation::Memory memory;
    Result got;
    got.maps.resize(planes * gs::map_strips(width) * height * gs::kMapRow), got.vjp.resize(img1.size());
    gs::l1_ssim_cuda({images, valid, &got.l1, &got.ssim, got.maps.data(), &got.loss, 0.8f, 0.2f}, memory.queue());
    gs::l1_ssim_vjp_cuda({images, got.maps.data(), &grad_l1, &grad_ssim, got.vjp.data()}, memory.queue());
    // Means of values near 1, rounded to float; a gradient is a sum of some 242 products of its own.
    CHECK_NEAR(got.l1, l1, 1e-6);
    CHECK_NEAR(got.ssim, ssim, 2e-6);
    CHECK_NEAR(got.loss, 0.8 * l1 + 0.2 * (1 - ssim), 2e-6);
    for (size_t i = 0; i < gradient.size(); ++i)
      CHECK_NEAR(got.vjp[i], vjp[i], 2e-5 * largest + 2e-6 / double(img1.size()));
    std::vector<float> weighted(img1.size());  // weights and gradients change places
    const float one = 1;
    float no_l1 = -1;
    gs::l1_ssim_vjp_cuda({images, got.maps.data(), &one, &one, weighted.data(), grad_l1, grad_ssim}, memory.queue());
    CHECK(weighted == got.vjp);
    gs::l1_ssim_cuda({images, valid, &no_l1, nullptr, nullptr}, memory.queue());  // only the mean of L1 is wanted
    CHECK(no_l1 == got.l1);
    if (order == gs::emulation::Order::forward) first = got;
    CHECK(got.l1 == first.l1 && got.ssim == first.ssim && got.maps == first.maps && got.vjp == first.vjp);
  }
}

// Bands, of which each knows 10 rows of the others, give the sums, means and gradients of the whole image.
void check_bands(int64_t planes, int64_t height, int64_t width, const std::vector<int64_t>& borders) {
  std::mt19937 random(unsigned(height * 1000 + width));
  std::uniform_real_distribution<float> wide(-0.5f, 1.5f);
  std::vector<float> img1(planes * height * width);
  std::vector<uint8_t> img2(img1.size());
  for (float& x : img1) x = wide(random);
  for (uint8_t& x : img2) x = uint8_t(random());
  const gs::ImagePair<float> images = {img1.data(), img2.data(), true, planes, height, width, true};
  gs::emulation::Memory memory;
  const float one = 1;
  float l1, loss, band_l1, band_loss;
  std::vector<float> maps(planes * gs::map_strips(width) * height * gs::kMapRow), vjp(img1.size());
  gs::l1_ssim_cuda({images, false, &l1, nullptr, maps.data(), &loss, 0.8f, 0.2f}, memory.queue());
  gs::l1_ssim_vjp_cuda({images, maps.data(), &one, &one, vjp.data(), 0.8f, -0.2f}, memory.queue());
  std::vector<double> sums(2 * gs::sum_blocks(planes, height, width));
  for (size_t i = 0; i + 1 < borders.size(); ++i) {
    const gs::RowRange rows{borders[i], borders[i + 1]}, kept = gs::map_rows(rows, height);
    std::vector<float> known(img1.size(), NAN), band_vjp(img1.size());
    for (int64_t at = 0; at < int64_t(img1.size()); ++at)
      if (const int64_t row = at / width % height; row >= rows.begin - 10 && row < rows.end + 10) known[at] = img1[at];
    const gs::ImagePair<float> part = {known.data(), img2.data(), true, planes, height, width, true};
    std::vector<float> band_maps(planes * gs::map_strips(width) * (kept.end - kept.begin) * gs::kMapRow);
    gs::L1SsimCuda forward{part, false, nullptr, nullptr, band_maps.data()};
    forward.rows = &rows, forward.sums = sums.data();
    gs::l1_ssim_cuda(forward, memory.queue());
    gs::L1SsimVjpCuda backward{part, band_maps.data(), &one, &one, band_vjp.data(), 0.8f, -0.2f};
    backward.rows = &rows;
    gs::l1_ssim_vjp_cuda(backward, memory.queue());
    for (int64_t at = 0; at < int64_t(img1.size()); ++at) {
      const bool own = at / width % height >= rows.begin && at / width % height < rows.end;
      CHECK(band_vjp[at] == (own ? vjp[at] : 0));
    }
  }
  gs::L1SsimCuda means{images, false, &band_l1, nullptr, nullptr, &band_loss, 0.8f, 0.2f};
  means.sums = sums.data();
  gs::l1_ssim_means_cuda(means, memory.queue());
  CHECK(band_l1 == l1 && band_loss == loss);
}

void check_composite(int64_t pixels) {
  std::mt19937 random(3);
  std::uniform_int_distribution<int> byte(0, 255);
  std::vector<uint8_t> picture(4 * pixels);
  for (uint8_t& x : picture) x = uint8_t(byte(random));
  const float background[3] = {0.2f, 0, 1};
  std::vector<float> wanted(3 * pixels), got(3 * pixels);
  gs::composite({picture.data(), background, pixels, wanted.data()}, gs::serial_executor());
  gs::emulation::Memory memory;
  gs::composite({picture.data(), background, pixels, got.data()}, memory.queue());
  CHECK(got == wanted);
}

// A step that was halted leaves every output as it is.
void check_halted() {
  const int64_t height = 20, width = 30;
  const std::vector<float> img1(height * width, 0.5f), img2(height * width, 0.25f);
  const gs::ImagePair<float> images = {img1.data(), img2.data(), false, 1, height, width, true};
  const std::vector<uint8_t> picture(4 * height * width, 128);
  const float background[3] = {0, 0, 0}, one = 1;
  for (const int32_t halted : {1, 0}) {
    gs::emulation::Memory memory;
    float l1 = -1, ssim = -1, loss = -1;
    std::vector<float> maps(gs::map_strips(width) * height * gs::kMapRow, -1), vjp(img1.size(), -1);
    std::vector<float> composited(3 * height * width, -1);
    gs::Queue queue = memory.queue();
    queue.halted = &halted;
    gs::l1_ssim_cuda({images, false, &l1, &ssim, maps.data(), &loss, 0.8f, 0.2f}, queue);
    gs::l1_ssim_vjp_cuda({images, maps.data(), &one, &one, vjp.data(), 1, 1}, queue);
    gs::composite({picture.data(), background, height * width, composited.data()}, queue);
    for (const float out : {l1, ssim, loss, maps[0], vjp[0], composited[0]}) CHECK((out == -1) == (halted == 1));
  }
}

}  // namespace

int main() {
  for (unsigned byte = 0; byte < 256; ++byte) CHECK(gs::GS_ISA::to_float(byte) == float(byte) / 255.0f);
  check_halted();
  for (const int64_t pixels : {0, 1, 255, 257, 1000}) check_composite(pixels);
  for (bool valid : {false, true}) {
    check<uint8_t>(3, 37, 70, valid);
    check<float>(1, 12, 11, valid);
    check<float>(2, 65, 33, valid);
    check<float>(2, 13, 232, valid, false, 1);
  }
  // Sizes around the ends of tiles and of the threads' groups.
  for (const int64_t height : {2, 8, 9, 16, 17})
    for (const int64_t width : {4, 115, 116, 117}) check<float>(1, height, width, false, false, 1);
  // And of tiles of the CPU, which are 32 rows by 512 columns.
  check<float>(1, 33, 513, true, false, 1);
  check<float>(3, 1, 1, false);
  check<uint8_t>(3, 5, 130, false);
  check<uint8_t>(3, 37, 110, false, true);
  check_bands(3, 37, 130, {0, 16, 37});
  check_bands(1, 70, 9, {0, 0, 16, 32, 48, 48, 70, 70});
  check_bands(64, 70, 125, {0, 16, 48, 70});  // blocks of two tiles
  // So many tiles that a block takes two, and that those of the backward are higher.
  check<uint8_t>(342, 17, 2, false, false, 1);
  return gs::finish_tests("CUDA SSIM, emulated");
}
