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

// last: whether the channels are an image's last axis.
template <class T>
gs::Channels<T> channels_of(const Tensor& values, double cap, bool stops, gs::Image image, bool last) {
  const int64_t count = values.size(1);
  return {read<T>(values), values.stride(0), count, T(cap), stops, last ? 1 : int64_t(image.width) * image.height,
          last ? count : 1};
}

// Rows may lie apart, as colours do in splats.
Tensor with_whole_rows(const Tensor& values) { return values.stride(1) == 1 ? values : packed(values); }

// cap: the largest alpha. last: the image is (1, H, W, C), and there is an alpha (1, H, W, 1).
std::tuple<Tensor, Tensor, Tensor, Tensor> blend_channels_op(const Tensor& splats, const Tensor& channels,
                                                             const Tensor& instances, const Tensor& ranges,
                                                             const Tensor& background, int64_t height, int64_t width,
                                                             double cap, bool last) {
  check_staged(splats);
  check_channels(channels, splats, cap);
  const gs::Image image = checked_image(height, width);
  check_lists(instances, ranges, splats, image);
  const Tensor rows = aligned(splats, 2), values = with_whole_rows(channels);
  const Tensor lists = packed(instances), bounds = packed(ranges);
  const Tensor bg = background_like(background, splats, channels.size(1));
  const int64_t h = image.height, w = image.width, count = channels.size(1);
  const Tensor color = empty(last ? Shape{1, h, w, count} : Shape{count, h, w}, splats);
  const Tensor transmittance = empty({1, h, w}, splats), ends = empty<int32_t>({h, w}, splats);
  const Tensor alpha = empty(last ? Shape{1, h, w, 1} : Shape{0}, splats);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::Blended<T> out{write<T>(color), write<T>(transmittance),         nullptr, write<int32_t>(ends),
                             nullptr,         last ? write<T>(alpha) : nullptr};
    gs::BlendInput<T> in = blend_input<T>(rows, lists, bounds, bg, image, {});
    in.channels = channels_of<T>(values, cap, false, image, last);
    GS_RUN(T, rows, blend, in, out);
  });
  return {color, transmittance, ends, alpha};
}

// The moments of the exponents, with the gradients of the first three channels in place of a colour's; the lengths of
// absolute gradients, and the gradient of the channels, of no rows unless they are wanted. stops: whether gradients end
// where alpha is `cap`.
std::tuple<Tensor, Tensor, Tensor> channel_moments_op(List<Tensor> source, const Tensor& channels,
                                                      const Tensor& grad_color, const MaybeTensor& grad_transmittance,
                                                      double cap, bool stops, bool absolute, bool wanted, bool last) {
  check_given(channels, "channels");
  GS_CHECK_VALUE(channels.dim() == 2, "channels must be (N, C), got ", channels.sizes());
  const BlendBackward in(source, grad_color, grad_transmittance, {}, {}, channels.size(1), last);
  const Tensor& splats = in.splats();
  check_staged(splats);
  check_channels(channels, splats, cap);
  const Tensor values = with_whole_rows(channels);
  const int64_t n = splats.size(0);
  const Tensor moments = empty({n, row_values(false, rays_of(splats))}, splats);
  const Tensor lengths = empty({absolute ? n : 0}, splats);
  const Tensor gradient = empty({wanted ? n : 0, channels.size(1)}, splats);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    gs::BlendInput<T> input = in.input<T>();
    input.channels = channels_of<T>(values, cap, stops, input.image, last);
    gs::BlendGradient<T> g = in.gradient<T>(write<T>(moments), absolute ? lengths : Tensor());
    if (wanted) g.values = write<T>(gradient);
    GS_RUN(T, splats, blend_vjp, input, g);
  });
  return {moments, lengths, gradient};
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "blend_channels(Tensor splats, Tensor channels, Tensor instances, Tensor ranges, Tensor background, int height, "
      "int width, float cap, bool channels_last=False) -> (Tensor color, Tensor transmittance, Tensor last, Tensor "
      "alpha)",
      TORCH_BOX(&blend_channels_op));
  m.define(
      "channel_moments(Tensor[] source, Tensor channels, Tensor grad_color, Tensor? grad_transmittance, float cap, "
      "bool "
      "stops, bool absolute, bool wanted, bool channels_last=False) -> (Tensor moments, Tensor lengths, Tensor "
      "gradient)",
      TORCH_BOX(&channel_moments_op));
}

}  // namespace gs::ops
