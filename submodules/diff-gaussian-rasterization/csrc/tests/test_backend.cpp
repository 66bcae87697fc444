// The whole CPU backend, several threads, under the sanitizers: random scenes with poison in them, and its own sums.
#include <cmath>
#include <limits>
#include <random>
#include <thread>
#include <vector>

#include "gs/check.h"
#include "launch.h"
#include "math/splat.h"

using namespace gs::GS_ISA;

namespace {

std::mt19937 generator(4);
double normal() { return std::normal_distribution<double>()(generator); }

gs::Executor threads() {
  return {3, [](int64_t n, int64_t, const std::function<void(int64_t, int64_t)>& body) {
            std::vector<std::thread> running;
            for (int64_t i = 0; i < 3; ++i)
              if (n * i / 3 < n * (i + 1) / 3) running.emplace_back([&, i] { body(n * i / 3, n * (i + 1) / 3); });
            for (std::thread& thread : running) thread.join();
          }};
}

template <class T>
struct Parameters {
  int64_t count;
  std::vector<T> means, opacities, scales, rotations, dc, rest;

  explicit Parameters(int64_t n) : count(n) {
    for (int64_t i = 0; i < n; ++i) {
      for (int k = 0; k < 3; ++k) means.push_back(T(normal() + (k == 2 ? 4 : 0)));
      opacities.push_back(T(normal()));
      for (int k = 0; k < 3; ++k) scales.push_back(T(0.7 * normal() - 3)), dc.push_back(T(normal()));
      for (int k = 0; k < 4; ++k) rotations.push_back(T(normal()));
      for (int k = 0; k < 45; ++k) rest.push_back(T(0.2 * normal()));
    }
  }

  std::vector<std::vector<T>*> all() { return {&means, &opacities, &scales, &rotations, &dc, &rest}; }
};

template <class T>
struct Result {
  std::vector<T> color, transmittance, depth, gradient;
  std::vector<int32_t> radii, tile_counts;
  int64_t instances;
};

// Forward and backward of the sum of all pixels of all planes; allocations are exact, so that a sanitizer sees a step
// outside. The gradient holds means, means2d, opacities, scales, rotations, dc, rest, one after the other.
template <class T>
Result<T> run(const gs::Executor& executor, Parameters<T>& p, gs::Image image, bool antialiasing) {
  const T view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  const T full[16] = {T(1 / 0.6), 0, 0, 0, 0, T(1 / 0.6), 0, 0, 0, 0, 1, 1, 0, 0, T(-0.01), 0};
  const T center[3] = {0, 0, 0}, background[3] = {T(0.1), T(0.2), T(0.3)};
  gs::Scene<T> scene = {};
  scene.count = p.count;
  scene.means = p.means.data(), scene.opacities = p.opacities.data();
  scene.scales = p.scales.data(), scene.rotations = p.rotations.data();
  scene.sh_dc = p.dc.data(), scene.sh_rest = p.rest.data();
  scene.dc_stride = 3, scene.rest_stride = 45, scene.rest_bands = 15, scene.sh_degree = 3;
  scene.raw = true, scene.antialiasing = antialiasing, scene.scale_modifier = 1;
  scene.view = view, scene.projection = full, scene.center = center;
  scene.tan_x = scene.tan_y = 0.6, scene.image = image;

  const size_t n = p.count, pixels = size_t(image.width) * image.height;
  Result<T> out;
  std::vector<T> splats(kSplatValues * n), depths(n);
  std::vector<int32_t> rects(4 * n);
  out.tile_counts.resize(n), out.radii.resize(n);
  const gs::Projected<T> projected = {splats.data(),          depths.data(),    rects.data(),
                                      out.tile_counts.data(), out.radii.data(), nullptr};
  gs::GS_ISA::project(executor, scene, projected);
  out.instances = 0;
  for (int32_t count : out.tile_counts) out.instances += count;

  const size_t tiles = size_t((image.width + 15) / 16) * ((image.height + 15) / 16);
  std::vector<int32_t> instances(out.instances), slots(out.instances), last(pixels);
  std::vector<int64_t> ranges(tiles + 1), slot_offsets(n);
  gs::GS_ISA::bin(executor, p.count, projected, image, out.instances,
                  gs::Binned{instances.data(), slots.data(), ranges.data(), slot_offsets.data()});
  CHECK(ranges.front() == 0 && ranges.back() == out.instances);
  for (size_t t = 0; t < tiles; ++t)
    for (int64_t k = ranges[t] + 1; k < ranges[t + 1]; ++k) {
      const int32_t a = instances[k - 1], b = instances[k];
      CHECK(depths[a] < depths[b] || (depths[a] == depths[b] && a < b));
    }

  out.color.resize(3 * pixels), out.transmittance.resize(pixels), out.depth.resize(pixels);
  const gs::BlendInput<T> input = {splats.data(), instances.data(), ranges.data(), background, image};
  gs::GS_ISA::blend(executor, input,
                    gs::Blended<T>{out.color.data(), out.transmittance.data(), out.depth.data(), last.data()});

  const std::vector<T> ones(3 * pixels, T(1));
  std::vector<T> moments(kGradientValues * n);
  gs::GS_ISA::blend_vjp(executor, input,
                        gs::BlendGradient<T>{p.count, out.instances, slots.data(), slot_offsets.data(),
                                             out.tile_counts.data(), out.transmittance.data(), last.data(), ones.data(),
                                             ones.data(), ones.data(), moments.data()});
  out.gradient.assign(n * (3 + 3 + 1 + 3 + 4 + 3 + 45), T(-77));
  T* g = out.gradient.data();
  const gs::SceneGradient<T> gradient = {g,       g + 3 * n, g + 6 * n,  g + 7 * n, g + 10 * n,
                                         nullptr, nullptr,   g + 14 * n, g + 17 * n};
  gs::GS_ISA::project_vjp(executor, scene, out.tile_counts.data(), moments.data(), gradient);
  return out;
}

template <class T>
void check_finite(const std::vector<T>& values) {
  for (T value : values) CHECK(std::isfinite(value));
}

template <class T>
void test_threads_and_sizes() {
  for (const gs::Image image : {gs::Image{1, 1}, gs::Image{16, 16}, gs::Image{17, 31}, gs::Image{70, 33}})
    for (int64_t count : {0, 1, 700}) {
      Parameters<T> p(count);
      const Result<T> serial = run(gs::serial_executor(), p, image, true), parallel = run(threads(), p, image, true);
      CHECK(serial.color == parallel.color && serial.transmittance == parallel.transmittance);
      CHECK(serial.depth == parallel.depth && serial.gradient == parallel.gradient);
      CHECK(serial.radii == parallel.radii && serial.instances == parallel.instances);
      check_finite(serial.color), check_finite(serial.gradient);
      if (count == 0) CHECK(serial.color.back() == T(0.3) && serial.transmittance.back() == 1);
    }
}

// A gradient row for one splat, by finite differences of the sum that `run` takes the gradient of.
void test_gradient() {
  Parameters<double> p(40);
  const gs::Image image = {23, 19};
  const auto sum = [&] {
    const Result<double> r = run(gs::serial_executor(), p, image, false);
    double total = 0;
    for (const auto* plane : {&r.color, &r.transmittance, &r.depth})
      for (double value : *plane) total += value;
    return total;
  };
  const Result<double> at = run(gs::serial_executor(), p, image, false);
  const size_t n = p.count, offset[6] = {0, 6 * n, 7 * n, 10 * n, 14 * n, 17 * n};
  double covered = 0;
  for (int which : {1, 4, 5}) {  // the image is smooth in opacity and colour but for the 1/255 edge
    std::vector<double>& values = *p.all()[which];
    const size_t row = values.size() / n;
    for (size_t i = 0; i < n; i += 3) {
      const double h = 1e-7, before = values[i * row];
      values[i * row] = before + h;
      const double high = sum();
      values[i * row] = before - h;
      const double low = sum();
      values[i * row] = before;
      const double got = at.gradient[offset[which] + i * row];
      // A sum of some 2,000 with 1e-16 each, over 2 h.
      CHECK_NEAR(got, (high - low) / (2 * h), 2e-5);
      covered += std::abs(got);
    }
  }
  CHECK(covered > 1);
}

// Every poison in every parameter: no undefined step, no other splat disturbed, its own gradient finite; zero where
// it is not a number.
template <class T>
void test_poison() {
  using Limits = std::numeric_limits<T>;
  const gs::Image image = {40, 24};
  // Scales are logarithms: exp(30) px squared is within float's range, its cube is not.
  const T poison[] = {Limits::quiet_NaN(),
                      Limits::infinity(),
                      -Limits::infinity(),
                      Limits::max(),
                      Limits::lowest(),
                      Limits::min(),
                      Limits::denorm_min(),
                      T(1e20),
                      T(-1e20),
                      T(0),
                      T(1e10),
                      T(-50),
                      T(30),
                      T(40),
                      T(50)};
  Parameters<T> clean(30);
  constexpr int64_t kVictim = 11;
  Parameters<T> without = clean;
  without.opacities[kVictim] = -Limits::infinity();
  const Result<T> wanted = run(gs::serial_executor(), without, image, true);
  for (size_t which = 0; which < clean.all().size(); ++which)
    for (bool whole_row : {false, true})
      for (T value : poison) {
        Parameters<T> p = clean;
        std::vector<T>& values = *p.all()[which];
        const size_t row = values.size() / p.count;
        for (size_t k = 0; k < (whole_row ? row : 1); ++k) values[kVictim * row + k] = value;
        const Result<T> got = run(gs::serial_executor(), p, image, true);
        check_finite(got.color), check_finite(got.transmittance), check_finite(got.depth);
        check_finite(got.gradient);
        if (std::isfinite(value)) continue;
        CHECK(got.tile_counts[kVictim] == 0);
        if (which < 4) CHECK(got.radii[kVictim] == 0);  // colours are read of splats with tiles only
        CHECK(got.color == wanted.color && got.gradient == wanted.gradient);
      }
}

}  // namespace

int main() {
  test_threads_and_sizes<float>(), test_threads_and_sizes<double>();
  test_gradient();
  test_poison<float>(), test_poison<double>();
  return gs::finish_tests("rasterizer backend");
}
