#pragma once
// A random scene, and a forward and a backward pass through a backend, for tests.
#include <algorithm>
#include <cmath>
#include <memory>
#include <numeric>
#include <random>
#include <vector>

#include "backend.h"
#include "gs/check.h"
#include "math/layers.h"
#include "math/lens_pixels.h"
#include "math/splat.h"

using namespace gs::GS_ISA;

inline std::mt19937 generator(4);
inline double normal() { return std::normal_distribution<double>()(generator); }

template <class T>
struct Parameters {
  int64_t count;
  std::vector<T> means, opacities, scales, rotations, dc, rest;
  T view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}, full[16] = {};  // transposed
  gs::Lens<T> lens = {};
  bool rays = false;

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
gs::Lens<T> fisheye(T focal, T x, T y) {
  return {gs::Chart::kEquidistant, 4, 1, 2, 5 * focal, 50, focal, focal, focal, x, y, {}, {}, {}, {}};
}

// A lens with all kinds of distortion.
inline gs::Lens<float> distorted(gs::Chart chart, float focal, float x, float y) {
  gs::Lens<float> lens = {chart, 4, 1, 2, 200, 50, 4 * focal / 3, focal, focal + 1, x, y, {-0.05f, 0.01f}, {}, {}, {}};
  lens.radial[2] = 0.001f, lens.radial[3] = 0.0001f, lens.divisor[0] = 0.02f;
  lens.tangential[0] = 0.003f, lens.tangential[1] = 0.002f;
  return lens;
}

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
  scene.raw = scene.any_rotation = true, scene.antialiasing = antialiasing, scene.scale_modifier = 1;
  scene.view = p.view, scene.projection = p.full, scene.center = center;
  scene.tan_x = scene.tan_y = 0.6, scene.image = image, scene.lens = p.lens, scene.on_rays = p.rays;
  return scene;
}

// A forward of a scene, and what its backward needs. Allocations are exact, so that a sanitizer sees an access outside.
template <class T>
struct RenderedOf {
  std::vector<T> splats, depths, color, transmittance, inverse_depth, gradient, moments, layers, table;
  std::vector<int32_t> rects, tile_counts, radii, last, instances;
  std::vector<gs::TileRecord> records;
  std::vector<int64_t> ranges;
  std::vector<gs::SplatSlots> slots;
  int64_t slot_count = 0;
  T background[3] = {T(0.1), T(0.2), T(0.3)};
  gs::Scene<T> scene;
  gs::BlendInput<T> input;
  gs::BlendGradient<T> backward;

  size_t pixels() const { return size_t(scene.image.width) * scene.image.height; }
};
using Rendered = RenderedOf<float>;

// What is asked of projection and binning. rects, records: what projection gives to binning, which needs one of the
// two. slots: whether binning fills them. ahead: as a host that runs ahead gives it.
struct Asked {
  bool rects = true, records = true, slots = true;
  const gs::Ahead* ahead = nullptr;
};

template <class T>
gs::Lens<double> wide(const gs::Lens<T>& l) {
  gs::Lens<double> out = {l.chart,   l.limit,    l.reach,    l.field, l.steep, l.beyond, l.slope, l.focal_x,
                          l.focal_y, l.center_x, l.center_y, {},      {},      {},       {}};
  std::copy_n(l.radial, 4, out.radial), std::copy_n(l.divisor, 3, out.divisor);
  std::copy_n(l.tangential, 2, out.tangential), std::copy_n(l.prism, 2, out.prism);
  return out;
}

// Projects and bins, on an Executor or a Queue.
template <class T, class Where>
std::unique_ptr<RenderedOf<T>> bin_scene(const Where& where, const gs::Scene<T>& scene, const Asked& asked) {
  using gs::cuda::bin, gs::cuda::project, gs::GS_ISA::bin, gs::GS_ISA::project;
  using gs::cuda::lens_table, gs::GS_ISA::lens_table;
  auto out = std::make_unique<RenderedOf<T>>();
  RenderedOf<T>& r = *out;
  const gs::Image image = scene.image;
  const size_t n = scene.rows();
  r.scene = scene;
  r.splats.resize(splat_row(scene.rays()) * n), r.depths.resize(n), r.tile_counts.resize(n), r.radii.resize(n);
  r.rects.assign(4 * n, 0x7fffffff), r.records.resize(n);  // undefined values must not be used
  r.ranges.resize(size_t((image.width + 15) / 16) * ((image.height + 15) / 16) + 1);
  r.slots.resize(asked.slots ? n + 1 : 0);
  if (scene.rays() == gs::kLensRays) {
    r.table.resize(lens_table_values(image));
    lens_table(where, wide(scene.lens), image, r.table.data());
  }
  const gs::Projected<T> projected = {r.splats.data(),      r.depths.data(), asked.rects ? r.rects.data() : nullptr,
                                      r.tile_counts.data(), r.radii.data(),  asked.records ? r.records.data() : nullptr,
                                      scene.rays(),         r.table.data()};
  project(where, scene, projected);
  const auto take = [](void* context, int64_t count, int64_t slots) {
    RenderedOf<T>& to = *static_cast<RenderedOf<T>*>(context);
    to.instances.resize(count), to.slot_count = slots;
    return gs::Binned{to.instances.data(), to.ranges.data()};
  };
  bin(where, scene.rows(), projected, image,
      gs::BinMemory{take, &r, asked.slots ? r.slots.data() : nullptr, asked.ahead});
  return out;
}

// A forward's layers, with inverse depth. They are made on a Queue alone.
template <class T, class Where>
std::vector<T> memory_for_layers(const Where&, gs::Image image, int64_t instances) {
  return std::vector<T>(std::is_same_v<Where, gs::Queue> ? layer_values(image, instances, true) : 0, T(NAN));
}

// Projects, bins and blends; the gradient of every pixel's value is 1. On a Queue the forward gives its layers to the
// backward.
template <class T, class Where>
std::unique_ptr<RenderedOf<T>> render(const Where& where, const gs::Scene<T>& scene, const Asked& asked = {}) {
  using gs::cuda::blend, gs::GS_ISA::blend;
  auto out = bin_scene(where, scene, asked);
  RenderedOf<T>& r = *out;
  const size_t pixels = r.pixels();
  const int64_t room = int64_t(r.instances.size());
  r.color.resize(3 * pixels), r.transmittance.resize(pixels), r.inverse_depth.resize(pixels), r.last.resize(pixels);
  r.input = {r.splats.data(), r.instances.data(), r.ranges.data(), r.background, scene.image, room,
             scene.rays(),    r.table.data()};
  r.layers = memory_for_layers<T>(where, scene.image, room);
  T* const layers = r.layers.empty() ? nullptr : r.layers.data();
  blend(where, r.input,
        gs::Blended<T>{r.color.data(), r.transmittance.data(), r.inverse_depth.data(), r.last.data(), layers});
  r.gradient.assign(3 * pixels, T(1)), r.moments.resize(gradient_row(scene.rays()) * scene.rows());
  const T* const g = r.gradient.data();
  r.backward = {scene.rows(),     room,   r.slot_count, r.slots.data(), r.transmittance.data(), r.last.data(), g, g, g,
                r.moments.data(), layers, asked.ahead};
  return out;
}

// Gradients in memory: means, means2d, opacities, scales, rotations, sh_dc, sh_rest, one after the other; -77 before.
template <class T>
struct GradientsInMemory {
  std::vector<T> memory;
  gs::SceneGradient<T> pointers;
  explicit GradientsInMemory(int64_t n) : memory(n * 62, T(-77)) {
    T* g = memory.data();
    pointers = {g, g + 3 * n, g + 6 * n, g + 7 * n, g + 10 * n, nullptr, nullptr, g + 14 * n, g + 17 * n};
  }
};

// Checks the lists of a forward that was not halted.
template <class T>
void check_lists_of(const RenderedOf<T>& r, int64_t instances) {
  CHECK(r.slot_count >= r.slots.back().first);
  CHECK(instances == std::accumulate(r.tile_counts.begin(), r.tile_counts.end(), int64_t(0)));
  CHECK(r.ranges.front() == 0 && r.ranges.back() == instances);
  for (size_t t = 0; t + 1 < r.ranges.size(); ++t)
    for (int64_t k = r.ranges[t] + 1; k < r.ranges[t + 1]; ++k) {
      const int32_t a = r.instances[k - 1], b = r.instances[k];
      CHECK(r.depths[a] < r.depths[b] || (r.depths[a] == r.depths[b] && a < b));
    }
}

// Forward and backward of the sum of all pixels of all planes. records: projection gives binning a record of each splat
// besides its rectangle. A gradient of a halted run is -77. absolute: with the lengths of absolute gradients.
template <class T, class Where>
Result<T> run(const Where& where, Parameters<T>& p, gs::Image image, bool antialiasing, bool records = false,
              const gs::Ahead* ahead = nullptr, bool absolute = false) {
  using gs::cuda::blend_vjp, gs::cuda::mark_decisive, gs::cuda::project_vjp;
  using gs::GS_ISA::blend_vjp, gs::GS_ISA::mark_decisive, gs::GS_ISA::project_vjp;
  const auto r = render(where, scene_of(p, image, antialiasing), Asked{true, records, true, ahead});
  Result<T> out;
  out.instances = ahead ? r->ranges.back() : int64_t(r->instances.size());
  const bool halted = ahead && *ahead->halted;
  CHECK(ahead || r->slot_count == r->slots.back().first);
  if (!halted) check_lists_of(*r, out.instances);
  static_assert(sizeof(bool) == 1);
  out.decisive.resize(p.count);
  if (!halted) mark_decisive(where, r->input, r->last.data(), reinterpret_cast<bool*>(out.decisive.data()));
  out.absolute.assign(absolute ? p.count : 0, T(-77));
  if (absolute) r->backward.absolute = out.absolute.data();
  blend_vjp(where, r->input, r->backward);
  GradientsInMemory<T> gradient(p.count);
  project_vjp(where, r->scene, r->tile_counts.data(), r->moments.data(), gradient.pointers);
  out.gradient = std::move(gradient.memory), out.depth = std::move(r->inverse_depth);
  out.color = std::move(r->color), out.transmittance = std::move(r->transmittance);
  out.radii = std::move(r->radii), out.tile_counts = std::move(r->tile_counts);
  return out;
}
