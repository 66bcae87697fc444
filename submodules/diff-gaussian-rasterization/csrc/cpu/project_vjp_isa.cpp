// The backward of projection: to rows of gradients, or straight to every Gaussian's step.
#include <cstring>
#include <type_traits>

#include "../backend.h"
#include "../math/scene_row.h"
#include "adam_rows.h"
#include "lazy_rows.h"

GS_ISA_BEGIN

namespace {

constexpr int64_t kBlock = 128;  // Gaussians whose gradients, some 30 KB of floats, stay in a core's cache
constexpr int kRestValues = 3 * (sh_count(kMaxShDegree) - 1);

template <class T>
T* from_row(T* rows, int64_t first, int64_t row) {
  return rows ? rows + first * row : nullptr;
}

// The Gaussians [first, first + count) of a scene, and their gradients.
template <class T>
Scene<T> part_of(Scene<T> s, int64_t first, int64_t count) {
  s.count = count;
  s.means = from_row(s.means, first, 3), s.opacities = from_row(s.opacities, first, 1);
  s.scales = from_row(s.scales, first, 3), s.rotations = from_row(s.rotations, first, 4);
  s.cov3d = from_row(s.cov3d, first, 6), s.colors = from_row(s.colors, first, 3);
  s.sh_dc = from_row(s.sh_dc, first, s.dc_stride), s.sh_rest = from_row(s.sh_rest, first, s.rest_stride);
  return s;
}
template <class T>
SceneGradient<T> part_of(const SceneGradient<T>& g, int64_t first, int rest_bands) {
  return {from_row(g.means, first, 3),  from_row(g.means2d, first, 3),   from_row(g.opacities, first, 1),
          from_row(g.scales, first, 3), from_row(g.rotations, first, 4), from_row(g.cov3d, first, 6),
          from_row(g.colors, first, 3), from_row(g.sh_dc, first, 3),     from_row(g.sh_rest, first, 3 * rest_bands)};
}

// A compiler must neither inline nor clone it: each copy could fuse other products, and gradients must have the same
// bits whether they are written or stepped.
#ifdef __clang__
#define GS_ONE_COPY __attribute__((noinline))
#else
#define GS_ONE_COPY __attribute__((noipa))
#endif

template <class T>
GS_ONE_COPY void project_vjp_rows(const Scene<T>& s, const Camera<T>& camera, const int32_t* tile_counts,
                                  const T* moments, const SceneGradient<T>& out) {
  for (int64_t i = 0; i < s.count; ++i) {
    T* g_rest = out.sh_rest ? out.sh_rest + 3 * s.rest_bands * i : nullptr;
    if (tile_counts[i]) {
      project_vjp_row(s, camera, i, moments + kGradientValues * i, s.sh_rest + s.rest_stride * i, g_rest, out, i);
    } else {
      zero_gradient(i, out);
      if (g_rest) std::memset(g_rest, 0, 3 * s.rest_bands * sizeof(T));
    }
  }
}

// The gradients of a block's Gaussians.
template <class T>
struct BlockGradient {
  T means[3 * kBlock], means2d[3 * kBlock], opacities[kBlock], scales[3 * kBlock], rotations[4 * kBlock];
  T sh_dc[3 * kBlock], sh_rest[kRestValues * kBlock];

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

// Takes the steps of a block's Gaussians. Returns whether all values took theirs.
template <class T>
bool step_block(const GaussianStep<T>& in, const AdamStep<T>* steps, const int32_t* tile_counts, int64_t first,
                int64_t count, const BlockGradient<T>& gradient) {
  bool finite = true;
  for (int a = 0; a < kStepped; ++a) {
    const AdamInput<T>& to = in.attributes[a];
    if (!to.columns) continue;
    const auto take = [&](int64_t begin, int64_t rows) {
      const T* from = gradient.of(a) + (begin - first) * to.row;
      return adam_rows(steps[a], to, from, begin, rows, in.guard.stopped != nullptr);
    };
    const bool lazy = in.lazy.last && a >= kFirstLazy;
    const auto steps_too = [&](int64_t i) {
      return lazy ? steps_now(in.lazy, i, tile_counts[i]) : in.observed.radii[i] > 0;
    };
    finite &= in.sparse || lazy ? for_runs(first, first + count, steps_too, take) : take(first, count);
  }
  if (in.lazy.last) note_rows(in, tile_counts, first, count);
  return finite;
}

}  // namespace

template <class T>
void project_vjp(const Executor& executor, const Scene<T>& s, const int32_t* tile_counts, const T* moments,
                 const SceneGradient<T>& out) {
  const Camera<T> camera = camera_of(s);
  for_dynamic(executor, s.count, 4 * kBlock, [&](int64_t begin, int64_t end) {
    project_vjp_rows(part_of(s, begin, end - begin), camera, tile_counts + begin, moments + kGradientValues * begin,
                     part_of(out, begin, s.rest_bands));
  });
}

template <class T>
void project_vjp_step(const Executor& executor, const Scene<T>& s, const int32_t* tile_counts, const T* moments,
                      const GaussianStep<T>& step) {
  const Camera<T> camera = camera_of(s);
  AdamStep<T> steps[kStepped];
  for (int a = 0; a < kStepped; ++a) steps[a] = adam_step_of(step.attributes[a], step.sparse);
  const bool may = may_step(step.guard);
  bool finite = may;
  for_dynamic(executor, s.count, kBlock, [&](int64_t begin, int64_t end) {
    const int64_t count = end - begin;
    BlockGradient<T> gradient;
    SceneGradient<T> wanted = gradient.pointers();
    if (!step.attributes[kStepShRest].columns) wanted.sh_rest = nullptr;
    project_vjp_rows(part_of(s, begin, count), camera, tile_counts + begin, moments + kGradientValues * begin, wanted);
    observe_block(step.observed, begin, count, gradient);
    if (may && !step_block(step, steps, tile_counts, begin, count, gradient))
      __atomic_store_n(&finite, false, __ATOMIC_RELAXED);
  });
  if (may && step.lazy.last) note_step(step, steps);
  if (!finite && *step.guard.stopped == 0) *step.guard.stopped = step.guard.iteration;
}

#define GS_INSTANTIATE(T)                                                                                            \
  template void project_vjp<T>(const Executor&, const Scene<T>&, const int32_t*, const T*, const SceneGradient<T>&); \
  template void project_vjp_step<T>(const Executor&, const Scene<T>&, const int32_t*, const T*, const GaussianStep<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
