// Writes what the CPU backend gives for scenes that are alike on every platform, or compares it with another run's.
#include "../backend_run.h"
#include "gs/check_results.h"

namespace {

template <class T>
Parameters<T> same_scene(int64_t count) {
  Parameters<T> p(count);
  gs::SameNumbers numbers;
  const double offset[6] = {0, 0, -3, 0, 0, 0}, size[6] = {1.7, 1.7, 1.2, 1.7, 1.7, 0.3};
  for (int which = 0; which < 6; ++which)
    for (T& value : *p.all()[which]) value = T(offset[which] + size[which] * numbers.spread());
  for (int64_t i = 0; i < count; ++i) p.means[3 * i + 2] += 4;
  return p;
}

template <class T>
void add_images(gs::Results& results) {
  for (const gs::Image image : {gs::Image{17, 31}, gs::Image{150, 100}})
    for (const bool antialiasing : {false, true}) {
      Parameters<T> p = same_scene<T>(1500);
      const Result<T> r = run(gs::serial_executor(), p, image, antialiasing, true, nullptr, true);
      results.add("colour", r.color), results.add("transmittance", r.transmittance), results.add("depth", r.depth);
      results.add("gradient", r.gradient), results.add("absolute gradient", r.absolute);
      results.add("radii", r.radii), results.add("tile counts", r.tile_counts);
    }
}

// Three steps of Adam on the positions, with gradients of all sizes.
template <class T>
void add_steps(gs::Results& results) {
  Parameters<T> p = same_scene<T>(500);
  std::vector<T> gradient = p.rotations, mean(p.means.size()), square(p.means.size());
  for (int step = 1; step <= 3; ++step) {
    const gs::AdamInput<T> input = {
        p.means.data(), gradient.data(), mean.data(), square.data(), p.count, 3, 3, 1e-3, 0.9,
        0.999,          1e-15,           double(step)};
    gs::GS_ISA::adam(gs::serial_executor(), &input, 1, gs::StepGuard<T>{});
    for (T& value : gradient) value *= T(0.01);
  }
  results.add("values after Adam", p.means), results.add("Adam's squares", square);
}

void add_random_positions(gs::Results& results) {
  Parameters<float> p = same_scene<float>(500);
  std::vector<int64_t> items(p.count);
  std::iota(items.begin(), items.end(), 0);
  std::vector<float> children = p.means;
  gs::Displacement split{p.count, children.data(), p.scales.data(), p.rotations.data()};
  split.items = items.data(), split.seed = 7, split.draw = 1, split.iteration = 100, split.stream = 2;
  gs::displace(gs::serial_executor(), split);
  gs::Displacement noise{p.count, p.means.data(), p.scales.data(), p.rotations.data(), p.opacities.data()};
  noise.size = 0.1, noise.steepness = 100, noise.threshold = 0.005;
  noise.seed = 7, noise.iteration = 100, noise.stream = 2;
  gs::displace(gs::serial_executor(), noise);
  results.add("positions of children", children), results.add("positions with noise", p.means);
}

}  // namespace

int main(int argc, char** argv) {
  gs::Results results(argc, argv);
  add_images<float>(results), add_steps<float>(results), add_random_positions(results);
  add_images<double>(results), add_steps<double>(results);
  return results.finish("rasterizer results");
}
