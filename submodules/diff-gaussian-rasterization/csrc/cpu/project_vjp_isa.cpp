// The backward of projection: to rows of gradients, or straight to every Gaussian's step.
#include <cstring>
#include <type_traits>
#include <vector>

#include "../backend.h"
#include "../math/camera_gradient.h"
#include "project_vjp_rows.h"
#include "step_rows.h"

GS_ISA_BEGIN

namespace {

template <class T, class AnyCamera>
void vjp_rows(const Scene<T>& s, const AnyCamera& camera, const int32_t* tile_counts, const T* moments,
              const SceneGradient<T>& out) {
  if constexpr (kOnRays<AnyCamera> != kNoRays)
    project_vjp_on_rays(s, camera, tile_counts, moments, out);
  else
    project_vjp_rows(s, camera, tile_counts, moments, out);
}

// The gradients of a block's Gaussians.
template <class T>
struct BlockGradient {
  T means[3 * kVjpBlock], means2d[3 * kVjpBlock], opacities[kVjpBlock], scales[3 * kVjpBlock], rotations[4 * kVjpBlock];
  T sh_dc[3 * kVjpBlock], sh_rest[kMostRest * kVjpBlock];

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
  with_any_camera(s, [&](const auto& camera) {
    for_dynamic(executor, s.count, kVjpBlock, [&](int64_t begin, int64_t end) {
      vjp_rows(part_of(s, begin, end - begin), camera, tile_counts + begin, from_moments(s, moments, begin),
               part_of(out, begin, s.rest_bands));
    });
  });
}

template <class T>
void project_vjp_step(const Executor& executor, const Scene<T>& s, const int32_t* tile_counts, const T* moments,
                      const GaussianStep<T>& step) {
  if (step.camera) {
    const int64_t numbers = camera_numbers(s);
    std::vector<double> sums(numbers * sleep_blocks(s.count));
    camera_vjp(executor, s, tile_counts, moments, sums.data());
    sum_blocks(sleep_blocks(s.count), numbers, sums.data(), step.camera);
  }
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
  with_any_camera(s, [&](const auto& camera) {
    for_dynamic(executor, s.count, kVjpBlock, [&](int64_t begin, int64_t end) {
      if (s.awake && !s.awake[begin / kVjpBlock]) return;
      const int64_t count = end - begin;
      BlockGradient<T> gradient;
      SceneGradient<T> wanted = gradient.pointers();
      if (!step.attributes[kStepShRest].columns) wanted.sh_rest = nullptr;
      vjp_rows(part_of(s, begin, count), camera, tile_counts + begin, from_moments(s, moments, begin), wanted);
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
