// The checks of what gradients come from, and what a backend makes of it.
#include "gradient_source.h"

#include <limits>

#include "math/absolute.h"
#include "math/splat.h"

namespace gs::ops {

using gs::baseline::kAbsoluteValues, gs::baseline::kGradientValues, gs::baseline::kSplatValues;

namespace {

// Checks what both sources have; returns the counts contiguous.
Tensor checked_counts(const SceneTensors& scene, const Tensor& splats, const Tensor& tile_counts) {
  check_tensor(splats, "splats", scene.dtype(), scene.device(), {scene.count(), kSplatValues});
  check_counts(tile_counts, scene.count(), scene.device());
  return packed(tile_counts);
}

}  // namespace

int64_t row_values(bool absolute) { return kGradientValues + (absolute ? kAbsoluteValues : 0); }

Lists::Lists(const SceneTensors& scene, LISTS_PARAMETERS)
    : tile_counts_(checked_counts(scene, splats, tile_counts)), blend_(BACKWARD_ARGUMENTS) {
  blend_.take_layers(layers);
}

Rows::Rows(const SceneTensors& scene, ROWS_PARAMETERS, bool absolute, bool lengths)
    : image_(scene.image()), tile_counts_(checked_counts(scene, splats, tile_counts)) {
  check_tensor(rows, "rows", scene.dtype(), scene.device(), {-1, row_values(absolute)});
  check_tensor(counts, "counts", ScalarType::Int, scene.device(), {scene.count()});
  GS_CHECK(rows.size(0) <= std::numeric_limits<int32_t>::max(), rows.size(0), " rows are more than 2^31 - 1");
  GS_CHECK(rows.is_cpu() || scene.dtype() == ScalarType::Float, kFloatAlone);
  splats_ = aligned(splats, 2), counts_ = packed(counts);
  Tensor given = rows;
  rows_ = aligned(lengths ? given : torch::stable::narrow(given, 1, 0, kGradientValues), 2);
  if (rows.is_cpu()) check_sum();  // reading counts from a GPU waits for it
}

void Rows::check_sum() const {
  const int32_t *counts = read<int32_t>(counts_), *tile_counts = read<int32_t>(tile_counts_);
  int64_t sum = 0;
  for (int64_t i = 0; i < counts_.size(0); sum += counts[i++])
    GS_CHECK_VALUE(counts[i] == 0 || (counts[i] > 0 && tile_counts[i] != 0),
                   "counts must be 0 or more, and 0 where tile_counts is, got ", counts[i], " of splat ", i);
  GS_CHECK_VALUE(sum == rows_.size(0), "counts add up to ", sum, ", but there are ", rows_.size(0), " rows");
}

Tensor Rows::moments(const Tensor& lengths) const {
  Tensor moments = empty({counts_.size(0), kGradientValues}, rows_);
  with_scalar(moments.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    GS_DISPATCH(sum_rows, gs::torch_executor(), input<T>(), sums<T>(write<T>(moments), lengths));
  });
  return moments;
}

#ifdef GS_CUDA
void Lists::vjp(const gs::Queue& queue, const gs::Scene<float>& scene, const Tensor& lengths,
                const gs::cuda::GradientMemory& memory) const {
  gs::cuda::rasterize_vjp(queue, scene, blend_.input<float>(), blend_.gradient<float>(nullptr, lengths), memory);
}

void Lists::step(const gs::Queue& queue, const gs::Scene<float>& scene, const Tensor& lengths,
                 const gs::GaussianStep<float>& step) const {
  gs::cuda::rasterize_vjp_step(queue, scene, blend_.input<float>(), blend_.gradient<float>(nullptr, lengths), step);
}

void Rows::vjp(const gs::Queue& queue, const gs::Scene<float>& scene, const Tensor& lengths,
               const gs::cuda::GradientMemory& memory) const {
  gs::cuda::rows_vjp(queue, scene, input<float>(), sums<float>(nullptr, lengths), memory);
}

void Rows::step(const gs::Queue& queue, const gs::Scene<float>& scene, const Tensor& lengths,
                const gs::GaussianStep<float>& step) const {
  gs::cuda::rows_vjp_step(queue, scene, input<float>(), sums<float>(nullptr, lengths), step);
}
#endif

}  // namespace gs::ops
