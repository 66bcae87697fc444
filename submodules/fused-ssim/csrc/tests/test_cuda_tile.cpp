// The work of the CUDA kernels' threads between two barriers, run one after the other on the host, against the CPU
// backend, and its error against the CPU backend in double.
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <random>
#include <vector>

#include "backend.h"
#include "cuda/ssim_backward.h"
#include "cuda/ssim_forward.h"
#include "gs/check.h"

namespace {

using namespace gs::GS_ISA;

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
bool last_thread_first = false;

template <class Phase>
void all_threads(const Phase& phase) {
  for (int i = 0; i < kColumns; ++i) phase(last_thread_first ? kColumns - 1 - i : i);
}

// Shared memory that shows values which are not set.
template <class Shared>
std::unique_ptr<Shared> poisoned() {
  auto shared = std::make_unique<Shared>();
  std::fill_n(reinterpret_cast<float*>(shared.get()), sizeof(Shared) / sizeof(float), kNan);
  return shared;
}

template <class Source>
struct Images {
  int64_t planes, height, width;
  bool valid, clamp;
  std::vector<float> img1;
  std::vector<Source> img2;

  gs::ImagePair<float> pair() const {
    return {img1.data(), img2.data(), sizeof(Source) == 1, planes, height, width, clamp};
  }
  int64_t rim() const { return valid ? kReach : 0; }
  double windows() const { return double(planes) * double(height - rim()) * double(width - rim()); }
  Plane<Source> plane(const Tile& tile) const {
    const int64_t first = tile.plane * height * width;
    return {&img1[first], &img2[first], int(height), int(width), clamp};
  }
};

template <class Source>
Images<Source> random_images(int64_t planes, int64_t height, int64_t width, bool valid, bool clamp) {
  Images<Source> images{planes, height, width, valid, clamp, {}, {}};
  std::mt19937 random(unsigned(height * 10000 + width));
  std::uniform_real_distribution<float> uniform, wide(-0.5f, 1.5f);
  images.img1.resize(planes * height * width);
  images.img2.resize(images.img1.size());
  for (float& x : images.img1) x = clamp ? wide(random) : uniform(random);
  for (Source& x : images.img2) x = Source(sizeof(Source) == 1 ? 255 * uniform(random) : uniform(random));
  return images;
}

struct Result {
  double l1 = 0, ssim = 0;
  std::vector<float> gradient;  // of SSIM
};

template <bool kGradient, class Source>
Result run_forward(const Images<Source>& images, const Maps& maps, int forward_rows) {
  const Tiles tiles = Tiles::of(forward_rows, images.planes, {0, images.height}, images.width);
  const Frame frame{int(images.width), int(images.rim() / 2), float(1 / images.windows())};
  Result result;
  double unlike = 0;
  for (int64_t block = 0; block < tiles.count; ++block) {
    const auto shared = poisoned<ForwardTile>();
    std::vector<Sums> sums(kColumns);
    Tile tile = tile_of(tiles, unsigned(block));
    for (int i = 0; i < forward_rows / kForwardRows; ++i, tile.row += kForwardRows) {
      all_threads([&](int t) { column_stats(*shared, tile, images.plane(tile), t, sums[t]); });
      all_threads([&](int t) { window_rows<kGradient>(*shared, tile, frame, maps, t, sums[t]); });
    }
    for (const Sums& own : sums) result.l1 += own.l1, unlike += own.unlike;
  }
  result.l1 /= double(images.img1.size());
  result.ssim = 1 - unlike / images.windows();
  return result;
}

template <int kRows, class Source>
std::vector<float> run_backward(const Images<Source>& images, const Maps& maps, bool quads) {
  const Tiles tiles = Tiles::of(kRows, images.planes, {0, images.height}, images.width);
  std::vector<float> gradient(images.img1.size(), kNan);  // shows pixels that are not written
  for (int64_t block = 0; block < tiles.count; ++block) {
    const Tile tile = tile_of(tiles, unsigned(block));
    const auto shared = poisoned<BackwardTile<kRows>>();
    const Chain chain{0, 1, &gradient[tile.plane * images.height * images.width], quads};
    std::vector<WindowColumn<kRows>> windows(kColumns);
    all_threads([&](int t) { windows[t] = load_windows(*shared, tile, maps, int(images.width), t); });
    all_threads([&](int t) { gather_down(*shared, tile, maps, int(images.width), windows[t], t); });
    all_threads([&](int t) { gather_across(*shared, tile, images.plane(tile), chain, t); });
  }
  return gradient;
}

template <class Source>
Result run_kernels(const Images<Source>& images) {
  const int strips = int(gs::map_strips(images.width));
  std::vector<Four> memory(images.planes * strips * images.height * gs::kMapRow / 4, Four{{kNan, kNan, kNan, kNan}});
  const Maps maps{memory[0].of, int(images.height), strips, int(images.height)};
  Result result = run_forward<true>(images, maps, kForwardRows);
  result.gradient = run_backward<16>(images, maps, false);
  CHECK(run_backward<8>(images, maps, false) == result.gradient);
  const bool aligned = reinterpret_cast<uintptr_t>(images.img1.data()) % 16 == 0 && images.width % 4 == 0;
  if (aligned) CHECK(run_backward<16>(images, maps, true) == result.gradient);
  const Result plain = run_forward<false>(images, maps, kForwardRows);
  CHECK(plain.l1 == result.l1 && plain.ssim == result.ssim);
  const Result taller = run_forward<false>(images, maps, 2 * kForwardRows);  // other sums of floats
  CHECK_NEAR(taller.l1, result.l1, 2e-7 * result.l1);
  CHECK_NEAR(taller.ssim, result.ssim, 2e-7);
  return result;
}

// Values outside of [0, 1] get no gradient where the render is clamped.
template <class Source>
void cut_gradient(const Images<Source>& images, std::vector<float>& gradient) {
  for (size_t i = 0; i < gradient.size(); ++i)
    if (images.clamp && !in_unit(images.img1[i])) gradient[i] = 0;
}

template <class Source>
void check(int64_t planes, int64_t height, int64_t width, bool valid, bool clamp = false) {
  const Images<Source> images = random_images<Source>(planes, height, width, valid, clamp);
  double l1 = 0, ssim = 0;
  std::vector<float> wanted(images.img1.size());
  gs::GS_ISA::l1_ssim_cpu({images.pair(), valid, &l1, &ssim, wanted.data()}, gs::serial_executor());
  cut_gradient(images, wanted);
  const Result got = run_kernels(images);
  // A thread sums 8 values in float; their errors are not of one sign.
  CHECK_NEAR(got.l1, l1, 2e-7 * l1);
  CHECK_NEAR(got.ssim, ssim, 4 * 6e-8);
  float largest = 0;
  for (float x : wanted) largest = std::max(largest, std::abs(x));
  for (size_t i = 0; i < wanted.size(); ++i) CHECK_NEAR(got.gradient[i], wanted[i], 40 * 6e-8 * largest);

  last_thread_first = true;  // shows a thread that needs another's result of the same phase
  CHECK(run_kernels(images).gradient == got.gradient);
  last_thread_first = false;
}

void check_bytes() {
  for (int v = 0; v < 256; ++v) CHECK(to_float(unsigned(v)) == float(v) / 255.0f);
}

}  // namespace

int main() {
  check_bytes();
  // Sizes around the ends of tiles and of the threads' groups.
  for (const int64_t height : {1, 2, 5, 8, 9, 15, 16, 17, 45})
    for (const int64_t width : {1, 4, 11, 115, 116, 117}) check<float>(1, height, width, false);
  for (const int64_t width : {213, 232, 233, 240}) check<float>(2, 13, width, true);
  for (const int64_t height : {11, 12, 22, 23, 32, 33}) check<uint8_t>(2, height, 15, true);
  check<uint8_t>(3, 9, 132, false);
  check<uint8_t>(1, 45, 117, false, true);
  check<float>(1, 150, 112, true);
  return gs::finish_tests("fused-ssim/test_cuda_tile");
}
