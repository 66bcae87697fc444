// The checks of a backward's tensors, and the backward of blending.
#include "backward.h"

#include "math/layers.h"
#include "math/splat.h"
#include "math/tiles.h"
#include "scene.h"

namespace gs::ops {

using gs::baseline::kGradientValues, gs::baseline::kSplatValues, gs::baseline::layer_values, gs::baseline::tiles_of;

void check_splats(const Tensor& splats) {
  check_given(splats, "splats");
  const ScalarType type = splats.scalar_type();
  GS_CHECK_TYPE(type == ScalarType::Float || type == ScalarType::Double, "splats must be float32 or float64, got ",
                type);
  GS_CHECK_VALUE(splats.dim() == 2 && splats.size(1) == kSplatValues, "splats must be (N, ", kSplatValues, "), got ",
                 splats.sizes());
}

void check_lists(const Tensor& instances, const Tensor& ranges, const Tensor& splats, gs::Image image) {
  check_tensor(instances, "instances", ScalarType::Int, splats.device(), {-1});
  check_tensor(ranges, "ranges", ScalarType::Long, splats.device(), {tiles_of(image) + 1});
  if (!ranges.is_cpu()) return;
  const int64_t end = read<int64_t>(ranges)[tiles_of(image) * ranges.stride(0)], n = instances.size(0);
  GS_CHECK_VALUE(end <= n && (end <= 0 || splats.size(0) > 0), "ranges end at ", end, ", but there are ", n,
                 " instances of ", splats.size(0), " splats");
}

gs::Image image_of(const Tensor& last, const Tensor& splats) {
  check_tensor(last, "last", ScalarType::Int, splats.device(), {-1, -1});
  return checked_image(last.size(0), last.size(1));
}

void check_counts(const Tensor& tile_counts, int64_t count, Device device) {
  check_tensor(tile_counts, "tile_counts", ScalarType::Int, device, {count});
}

void check_projected(const Tensor& splats, const Tensor& depths, const Tensor& rects, const Tensor& tile_counts) {
  check_splats(splats);
  const Device device = splats.device();
  const int64_t n = splats.size(0);
  check_tensor(depths, "depths", splats.scalar_type(), device, {n});
  check_tensor(rects, "rects", ScalarType::Int, device, {n, 4});
  check_counts(tile_counts, n, device);
}

Tensor background_like(const Tensor& background, const Tensor& splats) {
  check_precise(background, "background", {3});
  return converted(background, splats);
}

gs::Image BlendBackward::checked(const Tensor& splats, const Tensor& instances, const Tensor& ranges,
                                 const Tensor& splat_slots, const Tensor& slots, const Tensor& last,
                                 const Tensor& transmittance, const Tensor& grad_color) {
  check_splats(splats);
  const Device device = splats.device();
  const gs::Image image = image_of(last, splats);
  check_lists(instances, ranges, splats, image);
  check_tensor(splat_slots, "splat_slots", ScalarType::Long, device, {splats.size(0) + 1, 2});
  check_tensor(slots, "slots", ScalarType::Int, device, {-1, 0});
  if (device.is_cpu()) {
    const int64_t end = read<int64_t>(splat_slots)[splats.size(0) * splat_slots.stride(0)];
    GS_CHECK_VALUE(end == slots.size(0), "splat_slots end at ", end, ", but there are ", slots.size(0), " slots");
  }
  check_tensor(transmittance, "transmittance", splats.scalar_type(), device, {1, image.height, image.width});
  check_given(grad_color, "grad_color");
  return image;
}

void BlendBackward::take_layers(const Tensor& layers) {
  check_tensor(layers, "layers", splats_.scalar_type(), splats_.device(), {-1});
  const int64_t wanted = layer_values(image_, instances_.size(0), depth_.defined());
  GS_CHECK_VALUE(!layers.size(0) || layers.size(0) >= wanted, "layers must have ", wanted, " values, got ",
                 layers.size(0));
  layers_ = aligned(layers, 4);
}

Tensor BlendBackward::plane(const MaybeTensor& t, int64_t channels) const {
  if (!t.has_value() || !t->defined()) return {};
  check_precise(*t, "the gradient of an image", {channels, image_.height, image_.width});
  return converted(*t, splats_);
}

Tensor absolute_like(const Tensor& splats, bool wanted) { return wanted ? empty({splats.size(0)}, splats) : Tensor(); }

Tensor blend_vjp(const BlendBackward& in, const Tensor& absolute) {
  Tensor moments = empty({in.splats().size(0), kGradientValues}, in.splats());
  with_scalar(moments.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, moments, blend_vjp, in.input<T>(), in.gradient<T>(write<T>(moments), absolute));
  });
  return moments;
}

}  // namespace gs::ops
