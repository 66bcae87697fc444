// The whole CPU backend under the sanitizers: threads, sizes, and poisoned scenes.
#include <limits>

#include "backend_run.h"
#include "gs/check_threads.h"

namespace {

template <class T>
void check_finite(const std::vector<T>& values) {
  for (T value : values) CHECK(std::isfinite(value));
}

template <class T>
void test_threads_and_sizes() {
  for (const gs::Image image : {gs::Image{1, 1}, gs::Image{16, 16}, gs::Image{17, 31}, gs::Image{70, 33}})
    for (int64_t count : {0, 1, 700}) {
      Parameters<T> p(count);
      p.rays = image.width >= 17;
      if (image.width == 17) p.lens = fisheye<T>(10, 8, 15);
      const Result<T> serial = run(gs::serial_executor(), p, image, true),
                      parallel = run(gs::three_threads(), p, image, true);
      CHECK(serial.color == parallel.color && serial.transmittance == parallel.transmittance);
      CHECK(serial.depth == parallel.depth && serial.gradient == parallel.gradient);
      CHECK(serial.radii == parallel.radii && serial.instances == parallel.instances);
      CHECK(serial.decisive == parallel.decisive);
      const Result<T> recorded = run(gs::three_threads(), p, image, true, true);
      CHECK(serial.color == recorded.color && serial.gradient == recorded.gradient);
      for (int64_t i = 0; i < count; ++i) CHECK(!serial.decisive[i] || serial.tile_counts[i] > 0);
      check_finite(serial.color), check_finite(serial.gradient);
      if (count == 0) CHECK(serial.color.back() == T(0.3) && serial.transmittance.back() == 1);
    }
}

// Every poison in every parameter: no undefined behaviour, and all results are finite.
void test_poison() {
  using Limits = std::numeric_limits<float>;
  // Scales are logarithms: the square of exp(30) px is within float's range, its cube is not.
  const float poison[] = {
      NAN, INFINITY, -INFINITY, Limits::max(),       Limits::lowest(), Limits::min(), 1e20f, -1e20f, 0, 1e10f,
      -50, 30,       40,        Limits::denorm_min()};
  const Parameters<float> clean(30);
  constexpr int64_t kVictim = 11;
  for (size_t which = 0; which < 6; ++which)
    for (const bool whole_row : {false, true})
      for (const float value : poison) {
        Parameters<float> p = clean;
        std::vector<float>& values = *p.all()[which];
        const size_t row = values.size() / p.count;
        std::fill_n(values.begin() + kVictim * row, whole_row ? row : 1, value);
        const Result<float> got = run(gs::serial_executor(), p, gs::Image{40, 24}, true);
        check_finite(got.color), check_finite(got.transmittance), check_finite(got.depth);
        check_finite(got.gradient);
      }
}

}  // namespace

int main() {
  test_threads_and_sizes<float>(), test_threads_and_sizes<double>();
  test_poison();
  return gs::finish_tests("rasterizer backend");
}
