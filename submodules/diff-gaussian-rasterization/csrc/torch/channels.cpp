// The ops of images of many channels, and of what programs for gsplat give and read.
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

// Calls run(T(), queue or executor), on the device of `like`; kWide: whether a GPU knows float64.
template <bool kWide, class Run>
void on_device(const Tensor& like, const Run& run) {
  with_scalar(like.scalar_type(), [&](auto zero) {
    if (!like.is_cuda()) return run(zero, gs::torch_executor());
#ifdef GS_CUDA
    if constexpr (kWide || std::is_same_v<decltype(zero), float>) {
      gs::TorchQueue queue(like.device());
      return run(zero, queue.queue());
    }
#endif
    GS_CHECK(false, kFloatAlone);
  });
}

// Splats that keep their shapes as programs for gsplat know them, zeros where they are not shown (math/gsplat.h); if
// packed those that are shown, and then also their tiles and their numbers.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> describe_op(
    const Tensor& splats, const Tensor& depths, const Tensor& tile_counts, int64_t height, int64_t width, bool packed) {
  check_splats(splats);
  const int64_t n = splats.size(0);
  check_tensor(depths, "depths", splats.scalar_type(), splats.device(), {n});
  check_counts(tile_counts, n, splats.device());
  const gs::Image image = checked_image(height, width);
  const Tensor values = gs::packed(splats), from = gs::packed(depths), counts = gs::packed(tile_counts);
  Tensor rows = empty<int64_t>({packed ? n : 0}, splats);
  Tensor radii, centers, to, conics, opacities, tiles;
  on_device<false>(splats, [&](auto zero, const auto& where) {
    using T = decltype(zero);
    gs::DescribeInput<T> in{n,    nullptr, int(splats.size(1)), read<T>(values), read<T>(from), read<int32_t>(counts),
                            image};
    const int64_t shown = in.count = packed ? list_shown(where, in, write<int64_t>(rows)) : n;
    radii = empty<int32_t>({shown, 2}, splats), centers = empty({shown, 2}, splats), to = empty({shown}, splats);
    conics = empty({shown, 3}, splats), opacities = empty({shown}, splats);
    tiles = empty<int32_t>({packed ? shown : 0}, splats);
    if (packed) rows = torch::stable::narrow(rows, 0, 0, shown), in.rows = read<int64_t>(rows);
    describe(where, in,
             gs::Descriptions<T>{write<int32_t>(radii), write<T>(centers), write<T>(to), write<T>(conics),
                                 write<T>(opacities), packed ? write<int32_t>(tiles) : nullptr});
  });
  return {radii, centers, to, conics, opacities, tiles, rows};
}

// The gradients of the description of which these are the moments: of centers, conics and opacities. rows: those of a
// packed description.
std::tuple<Tensor, Tensor, Tensor> describe_vjp_op(const Tensor& splats, const Tensor& tile_counts,
                                                   const Tensor& moments, const MaybeTensor& rows) {
  check_staged(splats);
  const int64_t n = splats.size(0);
  check_counts(tile_counts, n, splats.device());
  check_tensor(moments, "moments", splats.scalar_type(), splats.device(), {n, splats.size(1)});
  if (given(rows)) check_tensor(*rows, "rows", ScalarType::Long, splats.device(), {-1});
  const Tensor values = packed(splats), from = packed(moments), counts = packed(tile_counts);
  const Tensor listed = given(rows) ? packed(*rows) : Tensor();
  const int64_t shown = listed.defined() ? listed.size(0) : n;
  const Tensor centers = empty({shown, 2}, splats), conics = empty({shown, 3}, splats);
  const Tensor opacities = empty({shown}, splats);
  on_device<false>(splats, [&](auto zero, const auto& where) {
    using T = decltype(zero);
    const gs::DescribedInput<T> in{shown,
                                   listed.defined() ? read<int64_t>(listed) : nullptr,
                                   int(splats.size(1)),
                                   read<T>(values),
                                   read<T>(from),
                                   read<int32_t>(counts)};
    describe_vjp(where, in, gs::DescribedGradient<T>{write<T>(centers), write<T>(conics), write<T>(opacities)});
  });
  return {centers, conics, opacities};
}

// A view (4, 4) and intrinsics (3, 3) as Scene's view, projection and center.
std::tuple<Tensor, Tensor, Tensor> pinhole_op(const Tensor& pose, const Tensor& intrinsics, int64_t height,
                                              int64_t width) {
  check_precise(pose, "a view matrix", {4, 4});
  check_precise(intrinsics, "intrinsics", {3, 3});
  const gs::Image image = checked_image(height, width);
  const Tensor from = packed(pose), K = converted(intrinsics, pose);
  const Tensor view = empty({4, 4}, pose), projection = empty({4, 4}, pose), center = empty({3}, pose);
  on_device<true>(pose, [&](auto zero, const auto& where) {
    using T = decltype(zero);
    pinhole(where, read<T>(from), read<T>(K), image,
            gs::PinholeMatrices<T>{write<T>(view), write<T>(projection), write<T>(center)});
  });
  return {view, projection, center};
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
  m.define(
      "describe(Tensor splats, Tensor depths, Tensor tile_counts, int height, int width, bool packed=False) -> (Tensor "
      "radii, Tensor centers, "
      "Tensor depths, Tensor conics, Tensor opacities, Tensor tiles, Tensor rows)",
      TORCH_BOX(&describe_op));
  m.define(
      "describe_vjp(Tensor splats, Tensor tile_counts, Tensor moments, Tensor? rows=None) -> (Tensor centers, "
      "Tensor conics, Tensor opacities)",
      TORCH_BOX(&describe_vjp_op));
  m.define(
      "pinhole(Tensor pose, Tensor intrinsics, int height, int width) -> (Tensor view, Tensor projection, "
      "Tensor center)",
      TORCH_BOX(&pinhole_op));
}

}  // namespace gs::ops
