// The checks of what a backward takes, and what a backend makes of it.
#include "backward.h"

#include <limits>

#include "math/absolute.h"
#include "math/layers.h"
#include "math/splat.h"
#include "math/tiles.h"

namespace gs::ops {

using gs::baseline::gradient_row, gs::baseline::kAbsoluteValues, gs::baseline::kSplatRow, gs::baseline::splat_row;
using gs::baseline::layer_values, gs::baseline::tiles_of;

void check_splats(const Tensor& splats) {
  check_given(splats, "splats");
  const ScalarType type = splats.scalar_type();
  GS_CHECK_TYPE(is_floating(type), "splats must be float32 or float64, got ", type);
  GS_CHECK_VALUE(splats.dim() == 2 && (splats.size(1) == kSplatRow<gs::kNoRays> || rays_of(splats)),
                 "splats must be (N, ", kSplatRow<gs::kNoRays>, "), (N, ", kSplatRow<gs::kPinholeRays>, ") or (N, ",
                 kSplatRow<gs::kLensRays>, "), got ", splats.sizes());
}

void check_staged(const Tensor& splats) {
  check_splats(splats);
  GS_CHECK_VALUE(rays_of(splats) != gs::kLensRays,
                 "splats on the rays of a lens are drawn by `rasterize` alone, not stage by stage");
}

gs::Rays rays_of(const Tensor& splats) {
  const int64_t values = splats.size(1);
  return values == kSplatRow<gs::kLensRays>      ? gs::kLensRays
         : values == kSplatRow<gs::kPinholeRays> ? gs::kPinholeRays
                                                 : gs::kNoRays;
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

Tensor background_like(const Tensor& background, const Tensor& splats, int64_t channels) {
  check_precise(background, "background", {channels});
  return converted(background, splats);
}

int64_t row_values(bool absolute, gs::Rays rays) { return gradient_row(rays) + (absolute ? kAbsoluteValues : 0); }

BlendBackward::BlendBackward(SOURCE_PARAMETERS, const Tensor& table, int64_t channels, bool last) : table_(table) {
  GS_CHECK_VALUE(source.size() == kKept, "a backward takes ", int(kKept), " tensors that a forward has kept, got ",
                 source.size());
  std::copy(source.begin(), source.end(), kept_.begin());
  check_splats(splats());
  image_ = image_of(kept_[kLast], splats());
  check_lists_of_forward();
  for (Kept one : {kInstances, kRanges, kSplatSlots, kLast, kTransmittance}) kept_[one] = packed(kept_[one]);
  kept_[kSplats] = aligned(splats(), 2);
  kept_[kBackground] = background_like(kept_[kBackground], splats(), channels);
  const int64_t h = image_.height, w = image_.width;
  color_ = plane(grad_color, last ? Shape{1, h, w, channels} : Shape{channels, h, w});
  alpha_ = plane(grad_transmittance, {1, h, w}), depth_ = plane(grad_inverse_depth, {1, h, w});
  check_given(color_, "grad_color");
  check_layers();
  kept_[kLayers] = aligned(kept_[kLayers], 4);
}

void BlendBackward::check_lists_of_forward() const {
  const Device device = splats().device();
  check_counts(kept_[kTileCounts], splats().size(0), device);
  check_lists(kept_[kInstances], kept_[kRanges], splats(), image_);
  const Tensor& splat_slots = kept_[kSplatSlots];
  const int64_t n = splats().size(0);
  check_tensor(splat_slots, "splat_slots", ScalarType::Long, device, {n + 1, 2});
  check_tensor(kept_[kSlots], "slots", ScalarType::Int, device, {-1, 0});
  if (device.is_cpu()) {
    const int64_t end = read<int64_t>(splat_slots)[n * splat_slots.stride(0)], slots = kept_[kSlots].size(0);
    GS_CHECK_VALUE(end == slots, "splat_slots end at ", end, ", but there are ", slots, " slots");
  }
  check_tensor(kept_[kTransmittance], "transmittance", splats().scalar_type(), device,
               {1, image_.height, image_.width});
}

// Without layers, the backward makes its own.
void BlendBackward::check_layers() const {
  const Tensor& layers = kept_[kLayers];
  check_tensor(layers, "layers", splats().scalar_type(), splats().device(), {-1});
  const int64_t wanted = layer_values(image_, kept_[kInstances].size(0), depth_.defined());
  GS_CHECK_VALUE(!layers.size(0) || layers.size(0) >= wanted, "layers must have ", wanted, " values, got ",
                 layers.size(0));
}

Tensor BlendBackward::plane(const MaybeTensor& t, Sizes sizes) const {
  if (!t.has_value() || !t->defined()) return {};
  check_precise(*t, "the gradient of an image", sizes);
  return converted(*t, splats());
}

GradientSource::GradientSource(const SceneTensors& scene, SOURCE_PARAMETERS, bool absolute, bool lengths)
    : image_(scene.image()) {
  const bool rows = source.size() == 4 && !grad_color, moments = source.size() == 3 && !grad_color;
  GS_CHECK(!rows || scene.rays() != gs::kLensRays, "there are no gradient rows of Gaussians on the rays of a lens");
  GS_CHECK_VALUE(rows || moments || source.size() == kKept, "the source must be what a forward has kept, ", int(kKept),
                 " tensors, or splats, tile_counts, and rows and counts or moments, got ", source.size(), " tensors");
  check_tensor(source[kSplats], "splats", scene.dtype(), scene.device(), {scene.rows(), splat_row(scene.rays())});
  if (!rows && !moments) blend_.emplace(SOURCE_ARGUMENTS, scene.table());
  check_counts(source[kTileCounts], scene.rows(), scene.device());
  tile_counts_ = packed(source[kTileCounts]);
  if (rows) take_rows(scene, source, absolute, lengths);
  if (!moments) return;
  GS_CHECK_VALUE(!lengths, "moments have no absolute gradients");
  check_tensor(source[2], "moments", scene.dtype(), scene.device(), {scene.rows(), row_values(false, scene.rays())});
  moments_ = packed(source[2]);
}

void GradientSource::take_rows(const SceneTensors& scene, List<Tensor> source, bool absolute, bool lengths) {
  Tensor rows = source[2];
  const Tensor& counts = source[3];
  check_tensor(rows, "rows", scene.dtype(), scene.device(), {-1, row_values(absolute, scene.rays())});
  check_tensor(counts, "counts", ScalarType::Int, scene.device(), {scene.rows()});
  GS_CHECK(rows.size(0) <= std::numeric_limits<int32_t>::max(), rows.size(0), " rows are more than 2^31 - 1");
  GS_CHECK(rows.is_cpu() || scene.dtype() == ScalarType::Float, kFloatAlone);
  splats_ = aligned(source[kSplats], 2), counts_ = packed(counts);
  rows_ = aligned(lengths ? rows : torch::stable::narrow(rows, 1, 0, row_values(false, scene.rays())), 2);
  if (rows.is_cpu()) check_sum();  // reading counts from a GPU waits for it
}

void GradientSource::check_sum() const {
  const int32_t *counts = read<int32_t>(counts_), *tile_counts = read<int32_t>(tile_counts_);
  int64_t sum = 0;
  for (int64_t i = 0; i < counts_.size(0); sum += counts[i++])
    GS_CHECK_VALUE(counts[i] == 0 || (counts[i] > 0 && tile_counts[i] != 0),
                   "counts must be 0 or more, and 0 where tile_counts is, got ", counts[i], " of splat ", i);
  GS_CHECK_VALUE(sum == rows_.size(0), "counts add up to ", sum, ", but there are ", rows_.size(0), " rows");
}

Tensor GradientSource::moments(const Tensor& lengths) const {
  if (moments_.defined()) return moments_;
  const Tensor& like = blend_ ? blend_->splats() : splats_;
  Tensor moments = empty({like.size(0), row_values(false, rays_of(like))}, like);
  with_scalar(like.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    T* to = write<T>(moments);
    if (blend_)
      GS_DISPATCH(blend_vjp, gs::torch_executor(), blend_->input<T>(), blend_->gradient<T>(to, lengths));
    else
      GS_DISPATCH(sum_rows, gs::torch_executor(), input<T>(), sums<T>(to, lengths));
  });
  return moments;
}

#ifdef GS_CUDA
void GradientSource::vjp(const gs::Queue& queue, const gs::Scene<float>& scene, const Tensor& lengths,
                         const gs::cuda::GradientMemory& memory) const {
  if (moments_.defined())
    gs::cuda::project_vjp(queue, scene, read<int32_t>(tile_counts_), read<float>(moments_),
                          memory.take(memory.context));
  else if (blend_)
    gs::cuda::rasterize_vjp(queue, scene, blend_->input<float>(), blend_->gradient<float>(nullptr, lengths), memory);
  else
    gs::cuda::rows_vjp(queue, scene, input<float>(), sums<float>(nullptr, lengths), memory);
}

void GradientSource::step(const gs::Queue& queue, const gs::Scene<float>& scene, const Tensor& lengths,
                          const gs::GaussianStep<float>& step) const {
  GS_CHECK(!moments_.defined(), "a step is taken from gradient rows, or from what a forward has kept");
  if (blend_)
    gs::cuda::rasterize_vjp_step(queue, scene, blend_->input<float>(), blend_->gradient<float>(nullptr, lengths), step);
  else
    gs::cuda::rows_vjp_step(queue, scene, input<float>(), sums<float>(nullptr, lengths), step);
}

void GradientSource::camera(const gs::Queue& queue, const gs::Scene<float>& scene, double* out) const {
  if (moments_.defined())
    gs::cuda::camera_vjp(queue, scene, read<int32_t>(tile_counts_), read<float>(moments_), out);
  else
    gs::cuda::camera_vjp(queue, scene, input<float>(), out);
}
#endif

void check_camera_gradients(const SceneTensors& scene) {
  GS_CHECK(!scene.rays(), "projection='ray' has no gradients of cameras: take 'ewa'");
}

Tensor absolute_like(const SceneTensors& scene, bool wanted) {
  return wanted ? empty({scene.rows()}, scene.means()) : Tensor();
}

namespace {

Gradients vjp_and_lengths(const SceneTensors& scene, const GradientSource& source, const Tensor& lengths,
                          const Wanted& wanted) {
#ifdef GS_CUDA
  if (scene.device().is_cuda()) {
    gs::TorchQueue queue(scene.device(), halted());
    std::optional<SceneGradients> out;
    auto allocate = [&] { return out.emplace(scene, wanted).template pointers<float>(); };
    using Allocate = decltype(allocate);
    const gs::cuda::GradientMemory memory{[](void* context) { return (*static_cast<Allocate*>(context))(); },
                                          &allocate};
    source.vjp(queue.queue(), scene.scene<float>(), lengths, memory);
    if (!out) allocate();  // no Gaussians
    return out->all();
  }
#endif
  const Tensor moments = source.moments(lengths);
  const SceneGradients out(scene, wanted);
  with_scalar(scene.dtype(), [&](auto zero) {
    using T = decltype(zero);
    GS_DISPATCH(project_vjp, gs::torch_executor(), scene.scene<T>(), read<int32_t>(source.tile_counts()),
                read<T>(moments), out.pointers<T>());
  });
  return out.all();
}

}  // namespace

Gradients vjp(const SceneTensors& scene, const GradientSource& source, bool lengths, const Wanted& wanted) {
  const Tensor absolute = absolute_like(scene, lengths);
  Gradients all = vjp_and_lengths(scene, source, absolute, wanted);
  if (lengths) {
    Tensor column = torch::stable::select(std::get<kMeans2d>(all), 1, 2);
    torch::stable::copy_(column, absolute);
  }
  return all;
}

}  // namespace gs::ops
