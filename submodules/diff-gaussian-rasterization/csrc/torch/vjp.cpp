// The ops of the backwards: each stage by itself, both in one, and both with gradient rows in between.

#include "gradient_source.h"
#include "math/splat.h"

namespace gs::ops {

namespace {

using gs::baseline::kGradientValues;

Gradients project_vjp(const SceneTensors& in, const Tensor& tile_counts, const Tensor& moments, SceneGradients out) {
  with_scalar(in.dtype(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, moments, project_vjp, in.scene<T>(), read<int32_t>(tile_counts), read<T>(moments), out.pointers<T>());
  });
  return out.all();
}

// source: Lists or Rows. lengths: of absolute gradients, if it is defined. make: the SceneGradients.
template <class Source, class Make>
Gradients vjp(const SceneTensors& scene, const Source& source, const Tensor& lengths, const Make& make) {
#ifdef GS_CUDA
  if (scene.device().is_cuda()) {
    gs::TorchQueue queue(scene.device(), halted());
    std::optional<SceneGradients> out;
    auto allocate = [&] { return out.emplace(make()).template pointers<float>(); };
    using Allocate = decltype(allocate);
    const gs::cuda::GradientMemory memory{[](void* context) { return (*static_cast<Allocate*>(context))(); },
                                          &allocate};
    source.vjp(queue.queue(), scene.scene<float>(), lengths, memory);
    if (!out) allocate();  // no Gaussians
    return out->all();
  }
#endif
  return project_vjp(scene, source.tile_counts(), source.moments(lengths), make());
}

// The same, and the third value of a row of means2d becomes the length of its absolute gradient, instead of 0.
template <class Source, class Make>
Gradients vjp_with_lengths(const SceneTensors& scene, const Source& source, const Tensor& splats, bool absolute,
                           const Make& make) {
  const Tensor lengths = absolute_like(splats, absolute);
  Gradients all = vjp(scene, source, lengths, make);
  if (lengths.defined()) {
    Tensor column = torch::stable::select(std::get<kMeans2d>(all), 1, 2);
    torch::stable::copy_(column, lengths);
  }
  return all;
}

Tensor blend_vjp_op(BACKWARD_PARAMETERS) { return blend_vjp(BlendBackward(BACKWARD_ARGUMENTS)); }

Gradients project_vjp_op(SCENE_PARAMETERS, const Tensor& tile_counts, const Tensor& moments,
                         const std::vector<bool>& wanted) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  check_counts(tile_counts, scene.count(), scene.device());
  check_tensor(moments, "moments", scene.dtype(), scene.device(), {scene.count(), kGradientValues});
  return project_vjp(scene, packed(tile_counts), packed(moments), {scene, checked_wanted(wanted)});
}

Gradients rasterize_vjp_op(SCENE_PARAMETERS, LISTS_PARAMETERS, const std::vector<bool>& wanted, bool absolute) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  const Wanted wants = checked_wanted(wanted);
  return vjp_with_lengths(scene, Lists(scene, LISTS_ARGUMENTS), splats, absolute && wants[kMeans2d],
                          [&] { return SceneGradients(scene, wants); });
}

// The rows that rasterize_vjp sums, those of a splat side by side, in the order of its tiles, and their number for each
// splat. absolute: they end with what lengths of absolute gradients need.
std::tuple<Tensor, Tensor> blend_rows_op(BACKWARD_PARAMETERS, const Tensor& layers, bool absolute) {
  BlendBackward in(BACKWARD_ARGUMENTS);
  in.take_layers(layers);
  GS_CHECK(!ahead(), "blend_rows waits for the number of rows, so the host cannot run ahead");
  Tensor rows, counts = empty<int32_t>({splats.size(0)}, splats);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    auto take = [&](int64_t count) {
      rows = empty({count, row_values(absolute)}, splats);
      return write<T>(rows);
    };
    using Take = decltype(take);
    const gs::RowMemory<T> memory{[](void* context, int64_t count) { return (*static_cast<Take*>(context))(count); },
                                  &take, write<int32_t>(counts), absolute};
    GS_RUN(T, splats, blend_rows, in.input<T>(), in.gradient<T>(nullptr, {}), memory);
  });
  return {rows, counts};
}

// The rest of rasterize_vjp, the same bits. rows: of blend_rows, or of several calls of it on parts of the lists, each
// a run of whole tiles; then those of a splat come in the order of the parts.
Gradients rows_vjp_op(SCENE_PARAMETERS, ROWS_PARAMETERS, const std::vector<bool>& wanted, bool absolute) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  const Wanted wants = checked_wanted(wanted);
  const bool lengths = absolute && wants[kMeans2d];
  const Rows source(scene, ROWS_ARGUMENTS, absolute, lengths);
  return vjp_with_lengths(scene, source, splats, lengths, [&] { return SceneGradients(scene, wants); });
}

// Adds the gradients of a view to `sums`, the results of rows_vjp for another one or tensors like these, which share no
// memory. Rows of Gaussians that were not seen stay. With `absolute`, the third column of means2d is this view's alone.
void rows_vjp_add_op(SCENE_PARAMETERS, ROWS_PARAMETERS, List<Tensor> sums, bool absolute) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  const SceneGradients added(scene, sums);
  const bool lengths = absolute && sums[kMeans2d].size(0) > 0;
  const Rows source(scene, ROWS_ARGUMENTS, absolute, lengths);
  vjp_with_lengths(scene, source, splats, lengths, [&] { return added; });
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define("blend_vjp(" BACKWARD_SCHEMA ") -> Tensor moments", TORCH_BOX(&blend_vjp_op));
  m.define("project_vjp(" SCENE_SCHEMA ", Tensor tile_counts, Tensor moments, bool[9] wanted) -> " GRADIENTS_SCHEMA,
           TORCH_BOX(&project_vjp_op));
  m.define("rasterize_vjp(" SCENE_SCHEMA ", " LISTS_SCHEMA
           ", bool[9] wanted, bool absolute=False) -> " GRADIENTS_SCHEMA,
           TORCH_BOX(&rasterize_vjp_op));
  m.define("blend_rows(" BACKWARD_SCHEMA ", Tensor layers, bool absolute=False) -> (Tensor rows, Tensor counts)",
           TORCH_BOX(&blend_rows_op));
  m.define("rows_vjp(" SCENE_SCHEMA ", " ROWS_SCHEMA ", bool[9] wanted, bool absolute=False) -> " GRADIENTS_SCHEMA,
           TORCH_BOX(&rows_vjp_op));
  m.define("rows_vjp_add_(" SCENE_SCHEMA ", " ROWS_SCHEMA ", Tensor(a!)[] sums, bool absolute=False) -> ()",
           TORCH_BOX(&rows_vjp_add_op));
}

}  // namespace gs::ops
