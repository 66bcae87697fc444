// The backward of projection: to rows of gradients, or straight to every Gaussian's step.
#include <cstring>
#include <type_traits>

#include "../backend.h"
#include "adam_rows.h"
#include "one_copy.h"
#include "penalty_rows.h"
#include "scene_lanes.h"

GS_ISA_BEGIN

namespace {

constexpr int64_t kBlock = kSleepBlock;  // Gaussians whose gradients, some 30 KB of floats, stay in a core's cache

template <class T>
SceneGradient<T> part_of(const SceneGradient<T>& g, int64_t first, int rest_bands) {
  return {from_row(g.means, first, 3),
          from_row(g.means2d, first, 3),
          from_row(g.opacities, first, 1),
          from_row(g.scales, first, 3),
          from_row(g.rotations, first, 4),
          from_row(g.cov3d, first, 6),
          from_row(g.colors, first, 3),
          from_row(g.sh_dc, first, 3),
          from_row(g.sh_rest, first, 3 * rest_bands),
          g.adds};
}

// Lists the Gaussians that were seen. Zeroes the gradients of the others, unless gradients are added.
template <class T>
int64_t list_seen(const Scene<T>& s, const int32_t* tile_counts, const SceneGradient<T>& out, int32_t* seen) {
  int64_t found = 0;
  for (int64_t i = 0; i < s.count; ++i) {
    if (tile_counts[i]) {
      seen[found++] = int32_t(i);
    } else if (!out.adds) {
      zero_gradient(i, out);
      if (out.sh_rest) std::memset(out.sh_rest + 3 * s.rest_bands * i, 0, 3 * s.rest_bands * sizeof(T));
    }
  }
  return found;
}

// Writes the values of a pack's Gaussians to rows of a gradient of n Gaussians, or adds them.
template <class T>
void write_or_add(typename Simd<T>::Vec* values, int row, int64_t n, const Pack<T>& pack, bool adds, T* to) {
  if (!to) return;
  if (adds) {
    typename Simd<T>::Vec before[kMostRest];
    read_rows(to, row, n, row, pack, before);
    for (int k = 0; k < row; ++k) values[k] = before[k] + values[k];
  }
  write_rows(values, row, row, pack, to);
}

// The gradients of a vector of Gaussians.
template <class T>
struct PackGradient {
  using V = typename Simd<T>::Vec;
  V means[3], means2d[3], opacities[1], scales[3], rotations[4], cov3d[6], colors[3], sh_dc[3];

  SceneGradient<V> pointers(const Scene<T>& s) {
    return {means, means2d, opacities, scales, rotations, s.cov3d ? cov3d : nullptr, colors, sh_dc, nullptr};
  }

  void write(const Scene<T>& s, const Pack<T>& pack, const SceneGradient<T>& out) {
    const auto write = [&](V* values, int row, T* to) { write_or_add(values, row, s.count, pack, out.adds, to); };
    write(means, 3, out.means), write(means2d, 3, out.means2d), write(opacities, 1, out.opacities);
    write(scales, 3, out.scales), write(rotations, 4, out.rotations), write(cov3d, 6, out.cov3d);
    write(colors, 3, out.colors), write(sh_dc, 3, out.sh_dc);
  }
};

// At most kBlock Gaussians.
template <class T, class AnyCamera>
GS_ONE_COPY void project_vjp_rows(const Scene<T>& s, const AnyCamera& camera, const int32_t* tile_counts,
                                  const T* moments, const SceneGradient<T>& out) {
  using V = typename Simd<T>::Vec;
  int32_t seen[kBlock];
  for_packs<T>(seen, list_seen(s, tile_counts, out, seen), [&](const Pack<T>& pack) {
    V m[kGradientValues], rest[kMostRest];
    read_rows(moments, kGradientValues, s.count, kGradientValues, pack, m);
    SceneLanes<T> row(s, pack);
    row.read_colors(s, pack, rest);
    PackGradient<T> gradient{};
    project_vjp_row(s, camera, row, m, rest, rest, gradient.pointers(s), 0);
    gradient.write(s, pack, out);
    write_or_add(rest, 3 * s.rest_bands, s.count, pack, out.adds, out.sh_rest);
  });
}

// The gradients of a block's Gaussians.
template <class T>
struct BlockGradient {
  T means[3 * kBlock], means2d[3 * kBlock], opacities[kBlock], scales[3 * kBlock], rotations[4 * kBlock];
  T sh_dc[3 * kBlock], sh_rest[kMostRest * kBlock];

  SceneGradient<T> pointers() {
    return {means, means2d, opacities, scales, rotations, nullptr, nullptr, sh_dc, sh_rest};
  }
  const T* of(int attribute) const {
    const T* const all[kStepped] = {means, opacities, scales, rotations, sh_dc, sh_rest};
    return all[attribute];
  }
};

// Adds the view to the statistics of a block's Gaussians.
template <class T>
void observe_block(const ObserveInput& in, int64_t first, int64_t count, const BlockGradient<T>& gradient) {
  if constexpr (std::is_same_v<T, float>)
    if (in.max_radii)
      gs::observe(serial_executor(), {count, in.max_radii + first, in.gradient_sums + first, in.views + first,
                                      in.radii + first, gradient.means2d});
}

// Adds the gradients of the penalty of a block's Gaussians, as far as their parameters take steps.
template <class T>
void penalise_block(const GaussianStep<T>& in, int64_t first, int64_t count, BlockGradient<T>& gradient) {
  const AdamInput<T>&logits = in.attributes[kStepOpacities], &log_scales = in.attributes[kStepScales];
  if (in.penalty.any())
    penalise_rows<T>({count, in.penalty, logits.value + first, log_scales.value + 3 * first,
                      logits.columns ? gradient.opacities : nullptr, log_scales.columns ? gradient.scales : nullptr});
}

// Takes the steps of a block's Gaussians. Returns whether all values took theirs.
template <class T>
bool step_block(const GaussianStep<T>& in, const AdamStep<T>* steps, int64_t first, int64_t count,
                const BlockGradient<T>& gradient) {
  bool finite = true;
  for (int a = 0; a < kStepped; ++a) {
    const AdamInput<T>& to = in.attributes[a];
    if (!to.columns) continue;
    const auto take = [&](int64_t begin, int64_t rows) {
      const T* from = gradient.of(a) + (begin - first) * to.row;
      return adam_rows(steps[a], to, from, begin, rows, in.guard.stopped != nullptr);
    };
    finite &= in.sparse ? for_runs(
                              first, first + count, [&](int64_t i) { return in.observed.radii[i] > 0; }, take)
                        : take(first, count);
  }
  return finite;
}

}  // namespace

template <class T>
void project_vjp(const Executor& executor, const Scene<T>& s, const int32_t* tile_counts, const T* moments,
                 const SceneGradient<T>& out) {
  with_camera(s, [&](const auto& camera) {
    for_dynamic(executor, s.count, kBlock, [&](int64_t begin, int64_t end) {
      project_vjp_rows(part_of(s, begin, end - begin), camera, tile_counts + begin, moments + kGradientValues * begin,
                       part_of(out, begin, s.rest_bands));
    });
  });
}

template <class T>
void project_vjp_step(const Executor& executor, const Scene<T>& s, const int32_t* tile_counts, const T* moments,
                      const GaussianStep<T>& step) {
  AdamStep<T> steps[kStepped];
  for (int a = 0; a < kStepped; ++a) steps[a] = adam_step_of(step.attributes[a], step.sparse);
  StepGuard<T> guard = step.guard;
  if constexpr (std::is_same_v<T, float>)
    if (step.now) {
      static_assert(sizeof steps == sizeof step.now->constants, "AdamStep has seven numbers");
      std::memcpy(steps, step.now->constants, sizeof steps);
      guard.iteration = step.now->iteration;
    }
  const bool may = may_step(guard);
  bool finite = may;
  with_camera(s, [&](const auto& camera) {
    for_dynamic(executor, s.count, kBlock, [&](int64_t begin, int64_t end) {
      if (s.awake && !s.awake[begin / kBlock]) return;
      const int64_t count = end - begin;
      BlockGradient<T> gradient;
      SceneGradient<T> wanted = gradient.pointers();
      if (!step.attributes[kStepShRest].columns) wanted.sh_rest = nullptr;
      project_vjp_rows(part_of(s, begin, count), camera, tile_counts + begin, moments + kGradientValues * begin,
                       wanted);
      observe_block(step.observed, begin, count, gradient);
      penalise_block(step, begin, count, gradient);
      if (may && !step_block(step, steps, begin, count, gradient)) __atomic_store_n(&finite, false, __ATOMIC_RELAXED);
    });
  });
  if (!finite && *guard.stopped == 0) *guard.stopped = guard.iteration;
}

#define GS_INSTANTIATE(T)                                                                                            \
  template void project_vjp<T>(const Executor&, const Scene<T>&, const int32_t*, const T*, const SceneGradient<T>&); \
  template void project_vjp_step<T>(const Executor&, const Scene<T>&, const int32_t*, const T*, const GaussianStep<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
