#pragma once
// A random scene, and a forward and a backward pass through a backend, for tests.
#include <cmath>
#include <numeric>
#include <random>
#include <vector>

#include "backend.h"
#include "gs/check.h"
#include "math/layers.h"
#include "math/splat.h"

using namespace gs::GS_ISA;

inline std::mt19937 generator(4);
inline double normal() { return std::normal_distribution<double>()(generator); }

template <class T>
struct Parameters {
  int64_t count;
  std::vector<T> means, opacities, scales, rotations, dc, rest;
  T view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}, full[16] = {};  // transposed

  explicit Parameters(int64_t n) : count(n) {
    for (int64_t i = 0; i < n; ++i) {
      for (int k = 0; k < 3; ++k) means.push_back(T(normal() + (k == 2 ? 4 : 0)));
      opacities.push_back(T(normal()));
      for (int k = 0; k < 3; ++k) scales.push_back(T(0.7 * normal() - 3)), dc.push_back(T(normal()));
      for (int k = 0; k < 4; ++k) rotations.push_back(T(normal()));
      for (int k = 0; k < 45; ++k) rest.push_back(T(0.2 * normal()));
    }
    project_view();
  }

  // Turns the view, which is a rotation before, into one that mirrors, shears and scales.
  void distort_view() {
    const T linear[9] = {T(-1.1), T(0.2), 0, T(0.1), T(0.8), T(-0.1), 0, T(0.15), T(0.9)};
    for (int i = 0; i < 9; ++i) view[4 * (i / 3) + i % 3] = linear[i];
    project_view();
  }

  // The full projection of a camera that is 62 degrees wide.
  void project_view() {
    for (int row = 0; row < 4; ++row) {
      const T* v = view + 4 * row;
      full[4 * row] = v[0] / T(0.6), full[4 * row + 1] = v[1] / T(0.6);
      full[4 * row + 2] = v[2] - T(0.01) * v[3], full[4 * row + 3] = v[2];
    }
  }

  std::vector<std::vector<T>*> all() { return {&means, &opacities, &scales, &rotations, &dc, &rest}; }
};

template <class T>
struct Result {
  std::vector<T> color, transmittance, depth, gradient, absolute;
  std::vector<int32_t> radii, tile_counts;
  std::vector<uint8_t> decisive;
  int64_t instances;
};

// The scene of a camera at the origin.
template <class T>
gs::Scene<T> scene_of(Parameters<T>& p, gs::Image image, bool antialiasing) {
  static const T center[3] = {0, 0, 0};
  gs::Scene<T> scene = {};
  scene.count = p.count;
  scene.means = p.means.data(), scene.opacities = p.opacities.data();
  scene.scales = p.scales.data(), scene.rotations = p.rotations.data();
  scene.sh_dc = p.dc.data(), scene.sh_rest = p.rest.data();
  scene.dc_stride = 3, scene.rest_stride = 45, scene.rest_bands = 15, scene.sh_degree = 3;
  scene.raw = true, scene.antialiasing = antialiasing, scene.scale_modifier = 1;
  scene.view = p.view, scene.projection = p.full, scene.center = center;
  scene.tan_x = scene.tan_y = 0.6, scene.image = image;
  return scene;
}

// Binning's results for a scene, on an Executor or a Queue. rects, records: whether projection gives them to binning,
// which needs one of the two. slots: whether binning fills them.
template <class T>
struct Bins {
  std::vector<int32_t> instances;
  std::vector<int64_t> ranges;
  std::vector<gs::SplatSlots> slots;
  int64_t slot_count = 0;
};
template <class T, class Where>
Bins<T> bin_scene(const Where& where, const gs::Scene<T>& scene, bool rects, bool records, bool slots) {
  using gs::cuda::bin, gs::cuda::project, gs::GS_ISA::bin, gs::GS_ISA::project;
  const size_t n = scene.count;
  std::vector<T> splats(kSplatValues * n), depths(n);
  std::vector<int32_t> rect(4 * n, 0x7fffffff), tile_counts(n), radii(n);  // undefined values must not be used
  std::vector<gs::TileRecord> record(n);
  const gs::Projected<T> projected = {splats.data(),      depths.data(), rects ? rect.data() : nullptr,
                                      tile_counts.data(), radii.data(),  records ? record.data() : nullptr};
  project(where, scene, projected);
  Bins<T> out;
  const gs::Image image = scene.image;
  out.ranges.resize(size_t((image.width + 15) / 16) * ((image.height + 15) / 16) + 1);
  out.slots.resize(slots ? n + 1 : 0);
  const auto take = [](void* context, int64_t count, int64_t slot_count) {
    Bins<T>& b = *static_cast<Bins<T>*>(context);
    b.instances.resize(count), b.slot_count = slot_count;
    return gs::Binned{b.instances.data(), b.ranges.data()};
  };
  bin(where, scene.count, projected, image, gs::BinMemory{take, &out, slots ? out.slots.data() : nullptr});
  return out;
}

// A forward's layers, with inverse depth. They are made on a Queue alone.
template <class T, class Where>
std::vector<T> memory_for_layers(const Where&, gs::Image image, int64_t instances) {
  return std::vector<T>(std::is_same_v<Where, gs::Queue> ? layer_values(image, instances, true) : 0, T(NAN));
}

// Forward and backward of the sum of all pixels of all planes, on an Executor or a Queue. Allocations are exact, so
// that a sanitizer sees an access outside. On a Queue the forward gives its layers to the backward. The gradient holds
// means, means2d, opacities, scales, rotations, dc, rest, one after the other. records: projection gives binning a
// record of each splat besides its rectangle. ahead: as a host that runs ahead gives it; a gradient of a halted run is
// -77. absolute: with the lengths of absolute gradients.
template <class T, class Where>
Result<T> run(const Where& where, Parameters<T>& p, gs::Image image, bool antialiasing, bool records = false,
              const gs::Ahead* ahead = nullptr, bool absolute = false) {
  using gs::cuda::bin, gs::cuda::blend, gs::cuda::blend_vjp, gs::cuda::project, gs::cuda::project_vjp;
  using gs::cuda::mark_decisive, gs::GS_ISA::mark_decisive;
  using gs::GS_ISA::bin, gs::GS_ISA::blend, gs::GS_ISA::blend_vjp, gs::GS_ISA::project, gs::GS_ISA::project_vjp;
  const T background[3] = {T(0.1), T(0.2), T(0.3)};
  const gs::Scene<T> scene = scene_of(p, image, antialiasing);
  const size_t n = p.count, pixels = size_t(image.width) * image.height;
  Result<T> out;
  std::vector<T> splats(kSplatValues * n), depths(n);
  std::vector<int32_t> rects(4 * n, 0x7fffffff);
  std::vector<gs::TileRecord> record(n);
  out.tile_counts.resize(n), out.radii.resize(n);
  const gs::Projected<T> projected = {splats.data(),          depths.data(),    rects.data(),
                                      out.tile_counts.data(), out.radii.data(), records ? record.data() : nullptr};
  project(where, scene, projected);

  const size_t tiles = size_t((image.width + 15) / 16) * ((image.height + 15) / 16);
  struct Lists {
    std::vector<int32_t> instances;
    std::vector<int64_t> ranges;
    int64_t slot_count;
  } lists{{}, std::vector<int64_t>(tiles + 1), 0};
  std::vector<gs::SplatSlots> slots(n + 1);
  const auto take = [](void* context, int64_t count, int64_t slots) {
    Lists& l = *static_cast<Lists*>(context);
    l.instances.resize(count), l.slot_count = slots;
    return gs::Binned{l.instances.data(), l.ranges.data()};
  };
  bin(where, p.count, projected, image, gs::BinMemory{take, &lists, slots.data(), ahead});
  auto& [instances, ranges, slot_count] = lists;
  const bool halted = ahead && *ahead->halted;
  std::vector<int32_t> last(pixels);
  out.instances = ahead ? ranges.back() : int64_t(instances.size());
  CHECK(halted || slot_count >= slots.back().first);
  CHECK(ahead || slot_count == slots.back().first);
  CHECK(halted || out.instances == std::accumulate(out.tile_counts.begin(), out.tile_counts.end(), int64_t(0)));
  CHECK(halted || (ranges.front() == 0 && ranges.back() == out.instances));
  for (size_t t = 0; t < tiles && !halted; ++t)
    for (int64_t k = ranges[t] + 1; k < ranges[t + 1]; ++k) {
      const int32_t a = instances[k - 1], b = instances[k];
      CHECK(depths[a] < depths[b] || (depths[a] == depths[b] && a < b));
    }

  out.color.resize(3 * pixels), out.transmittance.resize(pixels), out.depth.resize(pixels);
  const int64_t room = int64_t(instances.size());
  const gs::BlendInput<T> input = {splats.data(), instances.data(), ranges.data(), background, image, room};
  std::vector<T> layers = memory_for_layers<T>(where, image, room);
  blend(where, input,
        gs::Blended<T>{out.color.data(), out.transmittance.data(), out.depth.data(), last.data(),
                       layers.empty() ? nullptr : layers.data()});

  static_assert(sizeof(bool) == 1);
  out.decisive.resize(n);
  if (!halted) mark_decisive(where, input, last.data(), reinterpret_cast<bool*>(out.decisive.data()));

  const std::vector<T> ones(3 * pixels, T(1));
  std::vector<T> moments(kGradientValues * n);
  out.absolute.assign(absolute ? n : 0, T(-77));
  blend_vjp(
      where, input,
      gs::BlendGradient<T>{p.count, room, slot_count, slots.data(), out.transmittance.data(), last.data(), ones.data(),
                           ones.data(), ones.data(), moments.data(), layers.empty() ? nullptr : layers.data(), ahead,
                           absolute ? out.absolute.data() : nullptr});
  out.gradient.assign(n * (3 + 3 + 1 + 3 + 4 + 3 + 45), T(-77));
  T* g = out.gradient.data();
  const gs::SceneGradient<T> gradient = {g,       g + 3 * n, g + 6 * n,  g + 7 * n, g + 10 * n,
                                         nullptr, nullptr,   g + 14 * n, g + 17 * n};
  project_vjp(where, scene, out.tile_counts.data(), moments.data(), gradient);
  return out;
}
