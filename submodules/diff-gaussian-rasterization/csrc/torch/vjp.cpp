// The ops of the backward: to the gradients of the Gaussians, or no further than gradient rows.
#include "backward.h"
#include "math/camera_gradient.h"

namespace gs::ops {

namespace {

// absolute: the third value of a row of means2d becomes the length of its absolute gradient, instead of 0.
Gradients rasterize_vjp_op(SCENE_PARAMETERS, const std::vector<bool>& wanted, SOURCE_PARAMETERS, bool absolute) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  const Wanted wants = checked_wanted(wanted);
  const bool lengths = absolute && wants[kMeans2d];
  const GradientSource from(scene, SOURCE_ARGUMENTS, absolute, lengths);
  return vjp(scene, from, lengths, wants);
}

// The rows that rasterize_vjp sums, those of a splat side by side, in the order of its tiles, and their number for each
// splat. absolute: they end with what lengths of absolute gradients need. From the rows, or those of several calls on
// parts of the lists, each a run of whole tiles, rasterize_vjp makes the same bits; then those of a splat come in the
// order of the parts.
std::tuple<Tensor, Tensor> blend_rows_op(SOURCE_PARAMETERS, bool absolute) {
  const BlendBackward in(SOURCE_ARGUMENTS, {});
  check_staged(in.splats());
  GS_CHECK(!ahead(), "blend_rows waits for the number of rows, so the host cannot run ahead");
  const Tensor& splats = in.splats();
  KeptRows kept(splats, absolute);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, splats, blend_rows, in.input<T>(), in.gradient<T>(nullptr, {}), kept.memory<T>());
  });
  return {kept.rows, kept.counts};
}

// What blocks of gs::kSleepBlock Gaussians add to the gradients of the camera's numbers, (blocks, numbers) float64
// (math/camera_gradient.h), from splats, tile_counts, and the rows and counts of blend_rows, or moments.
Tensor camera_vjp_op(SCENE_PARAMETERS, List<Tensor> source, bool absolute) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  check_camera_gradients(scene);
  GS_CHECK_VALUE(source.size() == 3 || source.size() == 4,
                 "camera_vjp takes splats, tile_counts, and rows and counts or moments, got ", source.size(),
                 " tensors");
  const GradientSource from(scene, source, {}, {}, {}, absolute, false);
  const int64_t numbers = scene.has_lens() ? baseline::kLensCameraNumbers : baseline::kPinholeNumbers;
  Tensor out = empty<double>({gs::sleep_blocks(scene.count()), numbers}, scene.means());
#ifdef GS_CUDA
  if (scene.device().is_cuda()) {
    gs::TorchQueue queue(scene.device());
    from.camera(queue.queue(), scene.scene<float>(), write<double>(out));
    return out;
  }
#endif
  const Tensor moments = from.moments({});
  with_scalar(scene.dtype(), [&](auto zero) {
    using T = decltype(zero);
    GS_DISPATCH(camera_vjp, gs::torch_executor(), scene.scene<T>(), read<int32_t>(from.tile_counts()), read<T>(moments),
                write<double>(out));
  });
  return out;
}

// The sum of the rows of camera_vjp, or of all ranks' rows, in one order.
Tensor sum_blocks_op(const Tensor& sums) {
  check_given(sums, "sums");
  check_tensor(sums, "sums", ScalarType::Double, sums.device(), {-1, -1});
  const int64_t blocks = sums.size(0), numbers = sums.size(1);
  GS_CHECK_VALUE(numbers > 0, "sums must have columns, got ", sums.sizes());
  const Tensor from = packed(sums);
  Tensor out = empty<double>({numbers}, from);
#ifdef GS_CUDA
  if (from.is_cuda()) {
    gs::TorchQueue queue(from.device());
    gs::cuda::sum_blocks(queue.queue(), blocks, numbers, read<double>(from), write<double>(out));
    return out;
  }
#endif
  baseline::sum_blocks(blocks, numbers, read<double>(from), write<double>(out));
  return out;
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define("rasterize_vjp(" SCENE_SCHEMA ", bool[9] wanted, " SOURCE_SCHEMA
           ", bool absolute=False) -> " GRADIENTS_SCHEMA,
           TORCH_BOX(&rasterize_vjp_op));
  m.define("blend_rows(" SOURCE_SCHEMA ", bool absolute=False) -> (Tensor rows, Tensor counts)",
           TORCH_BOX(&blend_rows_op));
  m.define("camera_vjp(" SCENE_SCHEMA ", Tensor[] source, bool absolute=False) -> Tensor", TORCH_BOX(&camera_vjp_op));
  m.define("sum_blocks(Tensor sums) -> Tensor", TORCH_BOX(&sum_blocks_op));
}

}  // namespace gs::ops
