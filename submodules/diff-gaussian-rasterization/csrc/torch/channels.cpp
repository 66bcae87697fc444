// The ops of images of many channels.
#include "backward.h"

namespace gs::ops {

namespace {

// The values (N, C) that splats show. They are finite: a weight of 0 does not hide others.
// cap: the largest alpha, by whose complement a backward divides.
void check_channels(const Tensor& channels, const Tensor& splats, double cap) {
  check_tensor(channels, "channels", splats.scalar_type(), splats.device(), {splats.size(0), -1});
  GS_CHECK_VALUE(channels.size(1) > 0, "channels must have a column, got ", channels.sizes());
  GS_CHECK_VALUE(cap > 0 && float(cap) < 1, "cap must be between 0 and 1, got ", cap);
}

template <class T>
gs::Channels<T> channels_of(const Tensor& values, double cap, bool stops) {
  return {read<T>(values), values.size(1), values.size(1), T(cap), stops};
}

// cap: the largest alpha.
std::tuple<Tensor, Tensor, Tensor> blend_channels_op(const Tensor& splats, const Tensor& channels,
                                                     const Tensor& instances, const Tensor& ranges,
                                                     const Tensor& background, int64_t height, int64_t width,
                                                     double cap) {
  check_staged(splats);
  check_channels(channels, splats, cap);
  const gs::Image image = checked_image(height, width);
  check_lists(instances, ranges, splats, image);
  const Tensor rows = aligned(splats, 2), values = packed(channels);
  const Tensor lists = packed(instances), bounds = packed(ranges);
  const Tensor bg = background_like(background, splats, channels.size(1));
  const int64_t h = image.height, w = image.width;
  const Tensor color = empty({channels.size(1), h, w}, splats), transmittance = empty({1, h, w}, splats);
  const Tensor last = empty<int32_t>({h, w}, splats);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::Blended<T> out{write<T>(color), write<T>(transmittance), nullptr, write<int32_t>(last), nullptr};
    gs::BlendInput<T> in = blend_input<T>(rows, lists, bounds, bg, image, {});
    in.channels = channels_of<T>(values, cap, false);
    GS_RUN(T, rows, blend, in, out);
  });
  return {color, transmittance, last};
}

// The rows of blend_rows, in which the first three channels stand for the colour, and the gradient of the channels,
// of no rows unless it is wanted. On a GPU rows of no splat may follow. stops: whether gradients end where alpha is
// `cap`.
std::tuple<Tensor, Tensor, Tensor> channel_rows_op(List<Tensor> source, const Tensor& channels,
                                                   const Tensor& grad_color, const MaybeTensor& grad_transmittance,
                                                   double cap, bool stops, bool absolute, bool wanted) {
  check_given(channels, "channels");
  GS_CHECK_VALUE(channels.dim() == 2, "channels must be (N, C), got ", channels.sizes());
  const BlendBackward in(source, grad_color, grad_transmittance, {}, {}, channels.size(1));
  const Tensor& splats = in.splats();
  check_staged(splats);
  check_channels(channels, splats, cap);
  GS_CHECK(!ahead(), "channel_rows waits for the number of rows, so the host cannot run ahead");
  const Tensor values = packed(channels);
  const Tensor gradient = empty({wanted ? splats.size(0) : 0, channels.size(1)}, splats);
  KeptRows kept(splats, absolute);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    gs::BlendInput<T> input = in.input<T>();
    input.channels = channels_of<T>(values, cap, stops);
    GS_RUN(T, splats, blend_rows, input, in.gradient<T>(nullptr, {}),
           kept.memory<T>(wanted ? write<T>(gradient) : nullptr));
  });
  return {kept.rows, kept.counts, gradient};
}

// Splats as programs for gsplat know them, zeros where they have no tile (math/describe.h).
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> describe_op(const Tensor& splats, const Tensor& depths,
                                                               const Tensor& tile_counts) {
  check_splats(splats);
  const int64_t n = splats.size(0);
  check_tensor(depths, "depths", splats.scalar_type(), splats.device(), {n});
  check_counts(tile_counts, n, splats.device());
  const Tensor rows = packed(splats), from = packed(depths), counts = packed(tile_counts);
  const Tensor radii = empty<int32_t>({n, 2}, splats), centers = empty({n, 2}, splats), to = empty({n}, splats);
  const Tensor conics = empty({n, 3}, splats), opacities = empty({n}, splats);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::DescribeInput<T> in{n, int(splats.size(1)), read<T>(rows), read<T>(from), read<int32_t>(counts)};
    const gs::Descriptions<T> out{write<int32_t>(radii), write<T>(centers), write<T>(to), write<T>(conics),
                                  write<T>(opacities)};
    if (!splats.is_cuda()) return gs::describe(gs::torch_executor(), in, out);
#ifdef GS_CUDA
    if constexpr (std::is_same_v<T, float>) {
      gs::TorchQueue queue(splats.device());
      gs::cuda::describe(queue.queue(), in, out);
      return;
    }
#endif
    GS_CHECK(false, kFloatAlone);
  });
  return {radii, centers, to, conics, opacities};
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "blend_channels(Tensor splats, Tensor channels, Tensor instances, Tensor ranges, Tensor background, int height, "
      "int width, float cap) -> (Tensor color, Tensor transmittance, Tensor last)",
      TORCH_BOX(&blend_channels_op));
  m.define(
      "channel_rows(Tensor[] source, Tensor channels, Tensor grad_color, Tensor? grad_transmittance, float cap, bool "
      "stops, bool absolute, bool wanted) -> (Tensor rows, Tensor counts, Tensor gradient)",
      TORCH_BOX(&channel_rows_op));
  m.define(
      "describe(Tensor splats, Tensor depths, Tensor tile_counts) -> (Tensor radii, Tensor centers, Tensor depths, "
      "Tensor conics, Tensor opacities)",
      TORCH_BOX(&describe_op));
}

}  // namespace gs::ops
