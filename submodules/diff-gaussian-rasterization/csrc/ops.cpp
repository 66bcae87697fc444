// The only file that sees torch: checks, allocates, dispatches on device and instruction set.
#include <ATen/ops/empty.h>
#include <ATen/ops/topk.h>
#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <algorithm>
#include <array>
#include <limits>
#include <type_traits>

#include "gs/isa.h"
#include "gs/torch_executor.h"
#include "launch.h"
#ifdef GS_CUDA
#include "gs/torch_queue.h"
#endif

namespace {

using at::Tensor;
using MaybeTensor = std::optional<Tensor>;

constexpr int64_t kSplatValues = 10, kGradientValues = 10, kTile = 16;

// Everything that describes the Gaussians and the camera, in the order of the schemas.
#define SCENE_SCHEMA                                                                                          \
  "Tensor means, Tensor opacities, Tensor? scales, Tensor? rotations, Tensor? cov3d, Tensor? colors, "        \
  "Tensor? sh_dc, Tensor? sh_rest, Tensor view, Tensor projection, Tensor center, float tan_x, float tan_y, " \
  "int height, int width, int sh_degree, float scale_modifier, bool antialiasing, bool raw"
#define SCENE_PARAMETERS                                                                                              \
  const Tensor &means, const Tensor &opacities, const MaybeTensor &scales, const MaybeTensor &rotations,              \
      const MaybeTensor &cov3d, const MaybeTensor &colors, const MaybeTensor &sh_dc, const MaybeTensor &sh_rest,      \
      const Tensor &view, const Tensor &projection, const Tensor &center, double tan_x, double tan_y, int64_t height, \
      int64_t width, int64_t sh_degree, double scale_modifier, bool antialiasing, bool raw
#define SCENE_ARGUMENTS                                                                                               \
  means, opacities, scales, rotations, cov3d, colors, sh_dc, sh_rest, view, projection, center, tan_x, tan_y, height, \
      width, sh_degree, scale_modifier, antialiasing, raw

// `t` contiguous, with the dtype and on the device of `like`. Asking first: torch's conversion costs even when there is
// nothing to convert, and a step makes some ten.
Tensor converted(const Tensor& t, const Tensor& like) {
  const bool fits = t.scalar_type() == like.scalar_type() && t.device() == like.device();
  return fits ? t.contiguous() : t.to(like.options()).contiguous();
}

// Owns the contiguous tensors that a gs::Scene points into.
class SceneTensors {
 public:
  explicit SceneTensors(SCENE_PARAMETERS)
      : count_(means.size(0)),
        dtype_(means.scalar_type()),
        device_(means.device()),
        means_(take(means, {3}, "means")),
        opacities_(take(opacities, {}, "opacities")),
        scales_(take(scales, {3}, "scales")),
        rotations_(take(rotations, {4}, "rotations")),
        cov3d_(take(cov3d, {6}, "cov3d")),
        colors_(take(colors, {3}, "colors")),
        sh_dc_(take_bands(sh_dc, "sh_dc")),
        sh_rest_(take_bands(sh_rest, "sh_rest")),
        view_(matrix(view, 16, "view")),
        projection_(matrix(projection, 16, "projection")),
        center_(matrix(center, 3, "center")),
        tan_x_(tan_x),
        tan_y_(tan_y),
        scale_modifier_(scale_modifier),
        sh_degree_(int(sh_degree)),
        antialiasing_(antialiasing),
        raw_(raw),
        image_{int(width), int(height)} {
    TORCH_CHECK(cov3d_.defined() != (scales_.defined() && rotations_.defined()),
                "give either scales and rotations or cov3d");
    TORCH_CHECK(colors_.defined() != (sh_dc_.defined() && sh_rest_.defined()),
                "give either colors or sh_dc and sh_rest");
    TORCH_CHECK(sh_degree >= 0 && sh_degree <= 3, "sh_degree must be 0 to 3, got ", sh_degree);
    TORCH_CHECK(colors_.defined() || sh_rest_.size(1) >= (sh_degree + 1) * (sh_degree + 1) - 1, "sh_rest has ",
                colors_.defined() ? 0 : sh_rest_.size(1), " bands, too few for sh_degree ", sh_degree);
    TORCH_CHECK(rest_bands() <= 15, "sh_rest has ", rest_bands(), " bands, more than the 15 of degree 3");
    TORCH_CHECK(height > 0 && width > 0 && height < (1 << 24) && width < (1 << 24), "image size ", width, "x", height,
                " is out of range");
    TORCH_CHECK((width + kTile - 1) / kTile * ((height + kTile - 1) / kTile) <= std::numeric_limits<int32_t>::max(),
                "image size ", width, "x", height, " has more than 2^31 - 1 tiles of 16x16");
    TORCH_CHECK(count() < std::numeric_limits<int32_t>::max(), "more than 2^31 Gaussians");
  }

  int64_t count() const { return count_; }
  gs::Image image() const { return image_; }
  at::ScalarType dtype() const { return dtype_; }
  at::TensorOptions options() const { return means_.options(); }
  int64_t rest_bands() const { return sh_rest_.defined() ? sh_rest_.size(1) : 0; }

  template <class T>
  gs::Scene<T> scene() const {
    const auto pointer = [](const Tensor& t) { return t.defined() ? t.const_data_ptr<T>() : nullptr; };
    return {count(),
            pointer(means_),
            pointer(opacities_),
            pointer(scales_),
            pointer(rotations_),
            pointer(cov3d_),
            pointer(colors_),
            pointer(sh_dc_),
            pointer(sh_rest_),
            sh_dc_.defined() ? sh_dc_.stride(0) : 0,
            sh_rest_.defined() ? sh_rest_.stride(0) : 0,
            int(rest_bands()),
            sh_degree_,
            raw_,
            antialiasing_,
            T(scale_modifier_),
            pointer(view_),
            pointer(projection_),
            pointer(center_),
            tan_x_,
            tan_y_,
            image_};
  }

 private:
  Tensor take(const MaybeTensor& given, at::IntArrayRef tail, const char* name) const {
    if (!given.has_value() || !given->defined()) return {};
    const Tensor& t = *given;
    int64_t row = 1;
    for (int64_t size : tail) row *= size;
    TORCH_CHECK(t.device() == device_, name, " must be on the device of means, ", device_, ", got ", t.device());
    TORCH_CHECK(t.dim() >= 1 && t.size(0) == count_ && t.numel() == count_ * row, name, " must be (", count_, ", ", row,
                "), got ", t.sizes());
    TORCH_CHECK(t.scalar_type() == dtype_, name, " must have the dtype of means, got ", t.scalar_type());
    return t.contiguous();
  }
  // (N, bands, 3); rows may lie apart, so that a slice of more bands needs no copy.
  Tensor take_bands(const MaybeTensor& given, const char* name) const {
    if (!given.has_value() || !given->defined()) return {};
    const Tensor& t = *given;
    TORCH_CHECK(t.device() == device_, name, " must be on the device of means, ", device_, ", got ", t.device());
    TORCH_CHECK(t.dim() == 3 && t.size(0) == count() && t.size(2) == 3 && t.scalar_type() == dtype(), name,
                " must be (", count(), ", bands, 3) with the dtype of means, got ", t.sizes(), " ", t.scalar_type());
    return t.size(1) == 0 || (t.stride(2) == 1 && t.stride(1) == 3) ? t : t.contiguous();
  }
  Tensor matrix(const Tensor& t, int64_t values, const char* name) const {
    TORCH_CHECK(t.numel() == values, name, " must have ", values, " values, got ", t.sizes());
    return converted(t, means_);
  }

  int64_t count_;  // first: the checks of the tensors read these three
  at::ScalarType dtype_;
  at::Device device_;
  Tensor means_, opacities_, scales_, rotations_, cov3d_, colors_, sh_dc_, sh_rest_, view_, projection_, center_;
  double tan_x_, tan_y_, scale_modifier_;
  int sh_degree_;
  bool antialiasing_, raw_;
  gs::Image image_;
};

template <class F>
void with_scalar(at::ScalarType type, const F& f) {
  TORCH_CHECK(type == at::kFloat || type == at::kDouble, "means must be float32 or float64, got ", type);
  if (type == at::kFloat)
    f(float());
  else
    f(double());
}

// Runs a backend's function where the tensor `like` lies.
#ifdef GS_CUDA
#define RUN(T, like, fn, ...)                                                                               \
  if (!(like).is_cuda()) {                                                                                  \
    GS_DISPATCH(fn, gs::torch_executor(), __VA_ARGS__);                                                     \
  } else if constexpr (std::is_same_v<T, float>) {                                                          \
    gs::TorchQueue queue((like).device());                                                                  \
    gs::cuda::fn(queue.queue(), __VA_ARGS__);                                                               \
  } else {                                                                                                  \
    TORCH_CHECK(false, "the CUDA backend computes in float32, got float64: pass .float(), or use the CPU"); \
  }
#else
#define RUN(T, like, fn, ...) GS_DISPATCH(fn, gs::torch_executor(), __VA_ARGS__)
#endif

int64_t tiles_of(gs::Image image) { return ((image.width + kTile - 1) / kTile) * ((image.height + kTile - 1) / kTile); }

struct ProjectedTensors {
  Tensor splats, depths, rects, tile_counts, radii;
  Tensor records;  // a GPU's only
  template <class T>
  gs::Projected<T> pointers() {
    return {splats.mutable_data_ptr<T>(),
            depths.mutable_data_ptr<T>(),
            rects.defined() ? rects.mutable_data_ptr<int32_t>() : nullptr,
            tile_counts.mutable_data_ptr<int32_t>(),
            radii.mutable_data_ptr<int32_t>(),
            records.defined() ? static_cast<gs::TileRecord*>(records.mutable_data_ptr()) : nullptr};
  }
};

// `rects`: whether the caller wants them; a GPU with records has no other use for them.
ProjectedTensors project(const SceneTensors& in, bool rects) {
  const int64_t n = in.count();
  const auto ints = in.options().dtype(at::kInt);
  ProjectedTensors out;
  out.splats = at::empty({n, kSplatValues}, in.options());
  out.depths = at::empty({n}, in.options());
  out.tile_counts = at::empty({n}, ints);
  out.radii = at::empty({n}, ints);
  const int64_t tiles_across = std::max(in.image().width, in.image().height) / kTile;
  const bool records = in.options().device().is_cuda() && tiles_across < std::numeric_limits<uint16_t>::max();
  if (rects || !records) out.rects = at::empty({n, 4}, ints);
  if (records) out.records = at::empty({n, int64_t(sizeof(gs::TileRecord))}, in.options().dtype(at::kByte));
  with_scalar(in.dtype(), [&](auto zero) {
    using T = decltype(zero);
    RUN(T, out.splats, project, in.scene<T>(), out.pointers<T>());
  });
  return out;
}

// The Gaussians that ask for most, as words: often a few giants do for nearly all.
std::string most_tiles(const Tensor& tile_counts) {
  const auto [counts, rows] = at::topk(tile_counts.cpu(), std::min<int64_t>(3, tile_counts.size(0)));
  std::string words;
  for (int64_t k = 0; k < counts.size(0); ++k)
    words += (k ? ", " : "") + std::to_string(rows.const_data_ptr<int64_t>()[k]) + " (" +
             std::to_string(counts.const_data_ptr<int32_t>()[k]) + ")";
  return words;
}

struct BinnedTensors {
  Tensor instances, ranges;
  Tensor splat_slots;  // (N + 1, 2): gs::SplatSlots, the second value two of 32 bits
  Tensor slots;        // (S, 0): nothing but their number, which the backward's memory is sized by
};

// `slots`: whether the backward will need them.
BinnedTensors bin(ProjectedTensors& in, gs::Image image, bool slots) {
  const auto ints = in.depths.options().dtype(at::kInt), longs = in.depths.options().dtype(at::kLong);
  BinnedTensors out;
  out.splat_slots = at::empty({slots ? in.depths.size(0) + 1 : 0, 2}, longs);
  auto allocate = [&](int64_t total, int64_t slot_count) {
    const int64_t n = in.depths.size(0);
    TORCH_CHECK(total <= std::numeric_limits<int32_t>::max(), n, " Gaussians cover ", total,
                " tile instances, more than 2^31 - 1; most are those of Gaussian ", most_tiles(in.tile_counts),
                ": remove such giants, or render at a lower resolution or with fewer Gaussians");
    out.instances = at::empty({total}, ints), out.ranges = at::empty({tiles_of(image) + 1}, longs);
    out.slots = at::empty({slot_count, 0}, ints);
    return gs::Binned{out.instances.mutable_data_ptr<int32_t>(), out.ranges.mutable_data_ptr<int64_t>()};
  };
  using Allocate = decltype(allocate);
  const gs::BinMemory memory{
      [](void* context, int64_t total, int64_t slots) { return (*static_cast<Allocate*>(context))(total, slots); },
      &allocate, slots ? static_cast<gs::SplatSlots*>(out.splat_slots.mutable_data_ptr()) : nullptr};
  with_scalar(in.depths.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    RUN(T, in.depths, bin, in.depths.size(0), in.pointers<T>(), image, memory);
  });
  return out;
}

template <class T>
gs::BlendInput<T> blend_input(const Tensor& splats, const Tensor& instances, const Tensor& ranges,
                              const Tensor& background, gs::Image image) {
  return {splats.const_data_ptr<T>(), instances.const_data_ptr<int32_t>(), ranges.const_data_ptr<int64_t>(),
          background.const_data_ptr<T>(), image};
}

Tensor background_like(const Tensor& background, const Tensor& splats) {
  TORCH_CHECK(background.numel() == 3, "background must have 3 values, got ", background.sizes());
  return converted(background, splats);
}

struct BlendedTensors {
  Tensor color, transmittance, inverse_depth, last;
};

// `last`: whether the backward will need it.
BlendedTensors blend(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& background,
                     gs::Image image, bool inverse_depth, bool last) {
  const int64_t h = image.height, w = image.width;
  BlendedTensors out{at::empty({3, h, w}, splats.options()), at::empty({1, h, w}, splats.options()),
                     at::empty({inverse_depth ? 1 : 0, h, w}, splats.options()),
                     at::empty({last ? h : 0, w}, splats.options().dtype(at::kInt))};
  const Tensor bg = background_like(background, splats);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::Blended<T> blended{out.color.mutable_data_ptr<T>(), out.transmittance.mutable_data_ptr<T>(),
                                 inverse_depth ? out.inverse_depth.mutable_data_ptr<T>() : nullptr,
                                 last ? out.last.mutable_data_ptr<int32_t>() : nullptr};
    RUN(T, splats, blend, blend_input<T>(splats, instances, ranges, bg, image), blended);
  });
  return out;
}

// What the backward of blending takes: owns the tensors that gs::BlendInput and gs::BlendGradient point into.
class BlendBackward {
 public:
  BlendBackward(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& splat_slots,
                const Tensor& slots, const Tensor& background, const Tensor& last, const Tensor& transmittance,
                const Tensor& grad_color, const MaybeTensor& grad_transmittance, const MaybeTensor& grad_inverse_depth)
      : splats_(splats.contiguous()),
        instances_(instances),
        ranges_(ranges),
        splat_slots_(splat_slots.contiguous()),
        slot_count_(slots.size(0)),
        background_(background_like(background, splats)),
        last_(last),
        transmittance_(transmittance),
        image_{int(last.size(1)), int(last.size(0))},
        color_(plane(grad_color, 3)),
        alpha_(plane(grad_transmittance, 1)),
        depth_(plane(grad_inverse_depth, 1)) {}

  const Tensor& splats() const { return splats_; }

  template <class T>
  gs::BlendInput<T> input() const {
    return blend_input<T>(splats_, instances_, ranges_, background_, image_);
  }
  template <class T>
  gs::BlendGradient<T> gradient(T* moments) const {
    return {splats_.size(0),
            instances_.size(0),
            slot_count_,
            static_cast<const gs::SplatSlots*>(splat_slots_.const_data_ptr()),
            transmittance_.const_data_ptr<T>(),
            last_.const_data_ptr<int32_t>(),
            color_.const_data_ptr<T>(),
            depth_.defined() ? depth_.const_data_ptr<T>() : nullptr,
            alpha_.defined() ? alpha_.const_data_ptr<T>() : nullptr,
            moments};
  }

 private:
  Tensor plane(const MaybeTensor& t, int64_t channels) const {
    if (!t.has_value() || !t->defined()) return {};
    TORCH_CHECK(t->dim() == 3 && t->size(0) == channels && t->size(1) == image_.height && t->size(2) == image_.width,
                "the gradient of an image must be (", channels, ", ", image_.height, ", ", image_.width, "), got ",
                t->sizes());
    return converted(*t, splats_);
  }

  Tensor splats_, instances_, ranges_, splat_slots_;
  int64_t slot_count_;
  Tensor background_, last_, transmittance_;
  gs::Image image_;
  Tensor color_, alpha_, depth_;
};

Tensor blend_vjp(const BlendBackward& in) {
  Tensor moments = at::empty({in.splats().size(0), kGradientValues}, in.splats().options());
  with_scalar(moments.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    RUN(T, moments, blend_vjp, in.input<T>(), in.gradient<T>(moments.mutable_data_ptr<T>()));
  });
  return moments;
}

// In the order of GRADIENTS in ops.py; empty where not wanted.
using Gradients = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;
using Wanted = std::array<bool, 9>;

class SceneGradients {
 public:
  SceneGradients(const SceneTensors& in, const Wanted& wanted) : wanted_(wanted) {
    const std::array<std::vector<int64_t>, 9> rows{{{3}, {3}, {1}, {3}, {4}, {6}, {3}, {1, 3}, {in.rest_bands(), 3}}};
    for (int i = 0; i < 9; ++i) {
      std::vector<int64_t> sizes{wanted[i] ? in.count() : 0};
      sizes.insert(sizes.end(), rows[i].begin(), rows[i].end());
      tensors_[i] = at::empty(sizes, in.options());
    }
  }

  template <class T>
  gs::SceneGradient<T> pointers() {
    const auto p = [&](int i) { return wanted_[i] ? tensors_[i].mutable_data_ptr<T>() : nullptr; };
    return {p(0), p(1), p(2), p(3), p(4), p(5), p(6), p(7), p(8)};
  }
  Gradients all() const { return std::tuple_cat(tensors_); }

 private:
  Wanted wanted_;
  std::array<Tensor, 9> tensors_;
};

Gradients project_vjp(const SceneTensors& in, const Tensor& tile_counts, const Tensor& moments, const Wanted& wanted) {
  SceneGradients out(in, wanted);
  with_scalar(in.dtype(), [&](auto zero) {
    using T = decltype(zero);
    RUN(T, moments, project_vjp, in.scene<T>(), tile_counts.const_data_ptr<int32_t>(), moments.const_data_ptr<T>(),
        out.pointers<T>());
  });
  return out.all();
}

// ---- the ops ----

using Tensors5 = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;
using Tensors4 = std::tuple<Tensor, Tensor, Tensor, Tensor>;

Tensors5 project_op(SCENE_PARAMETERS) {
  const ProjectedTensors p = project(SceneTensors(SCENE_ARGUMENTS), true);
  return {p.splats, p.depths, p.rects, p.tile_counts, p.radii};
}

Tensors4 bin_op(const Tensor& splats, const Tensor& depths, const Tensor& rects, const Tensor& tile_counts,
                int64_t height, int64_t width, bool train) {
  ProjectedTensors p;
  p.splats = splats.contiguous(), p.depths = depths.contiguous(), p.rects = rects.contiguous();
  p.tile_counts = p.radii = tile_counts.contiguous();
  const BinnedTensors b = bin(p, {int(width), int(height)}, train);
  return {b.instances, b.ranges, b.splat_slots, b.slots};
}

Tensors4 blend_op(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& background,
                  int64_t height, int64_t width, bool inverse_depth, bool train) {
  const BlendedTensors b =
      blend(splats.contiguous(), instances, ranges, background, {int(width), int(height)}, inverse_depth, train);
  return {b.color, b.transmittance, b.inverse_depth, b.last};
}

#define BACKWARD_SCHEMA                                                                                   \
  "Tensor splats, Tensor instances, Tensor ranges, Tensor splat_slots, Tensor slots, "                    \
  "Tensor background, Tensor last, Tensor transmittance, Tensor grad_color, Tensor? grad_transmittance, " \
  "Tensor? grad_inverse_depth"
#define GRADIENTS_SCHEMA                                                                             \
  "(Tensor means, Tensor means2d, Tensor opacities, Tensor scales, Tensor rotations, Tensor cov3d, " \
  "Tensor colors, Tensor sh_dc, Tensor sh_rest)"
#define BACKWARD_PARAMETERS                                                                                            \
  const Tensor &splats, const Tensor &instances, const Tensor &ranges, const Tensor &splat_slots, const Tensor &slots, \
      const Tensor &background, const Tensor &last, const Tensor &transmittance, const Tensor &grad_color,             \
      const MaybeTensor &grad_transmittance, const MaybeTensor &grad_inverse_depth
#define BACKWARD_ARGUMENTS                                                                                        \
  splats, instances, ranges, splat_slots, slots, background, last, transmittance, grad_color, grad_transmittance, \
      grad_inverse_depth

Tensor blend_vjp_op(BACKWARD_PARAMETERS) { return blend_vjp(BlendBackward(BACKWARD_ARGUMENTS)); }

Gradients project_vjp_op(SCENE_PARAMETERS, const Tensor& tile_counts, const Tensor& moments, Wanted wanted) {
  return project_vjp(SceneTensors(SCENE_ARGUMENTS), tile_counts.contiguous(), moments.contiguous(), wanted);
}

using Rasterized = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

Rasterized rasterize_op(const Tensor& /*means2d: only receives a gradient*/, SCENE_PARAMETERS, const Tensor& background,
                        bool inverse_depth, bool train) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  ProjectedTensors p = project(scene, false);
  BinnedTensors b = bin(p, scene.image(), train);
  BlendedTensors o = blend(p.splats, b.instances, b.ranges, background, scene.image(), inverse_depth, train);
  return {o.color,     o.transmittance, o.inverse_depth, p.radii, p.splats, p.tile_counts,
          b.instances, b.ranges,        b.splat_slots,   b.slots, o.last};
}

Gradients rasterize_vjp_op(SCENE_PARAMETERS, BACKWARD_PARAMETERS, const Tensor& tile_counts, Wanted wanted) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  const BlendBackward in(BACKWARD_ARGUMENTS);
#ifdef GS_CUDA
  if (splats.is_cuda()) {
    gs::TorchQueue queue(splats.device());
    std::optional<SceneGradients> out;
    auto allocate = [&] { return out.emplace(scene, wanted).pointers<float>(); };
    using Allocate = decltype(allocate);
    const gs::cuda::GradientMemory memory{[](void* context) { return (*static_cast<Allocate*>(context))(); },
                                          &allocate};
    gs::cuda::rasterize_vjp(queue.queue(), scene.scene<float>(), in.input<float>(), in.gradient<float>(nullptr),
                            memory);
    if (!out) allocate();  // no Gaussians
    return out->all();
  }
#endif
  return project_vjp(scene, tile_counts, blend_vjp(in), wanted);
}

Tensor mark_visible_op(const Tensor& means, const Tensor& view) {
  TORCH_CHECK(means.dim() == 2 && means.size(1) == 3, "positions must be (N, 3), got ", means.sizes());
  TORCH_CHECK(view.numel() == 16, "the view matrix must be 4x4, got ", view.sizes());
  const Tensor rows = means.contiguous(), matrix = converted(view, means);
  Tensor visible = at::empty({rows.size(0)}, rows.options().dtype(at::kBool));
  with_scalar(rows.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    RUN(T, rows, mark_visible, rows.size(0), rows.const_data_ptr<T>(), matrix.const_data_ptr<T>(),
        visible.mutable_data_ptr<bool>());
  });
  return visible;
}

Tensor decisive_op(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& last) {
  Tensor decisive = at::zeros({splats.size(0)}, splats.options().dtype(at::kBool));
  const Tensor rows = splats.contiguous(), no_background = at::zeros({3}, splats.options());
  const gs::Image image{int(last.size(1)), int(last.size(0))};
  with_scalar(rows.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    RUN(T, rows, mark_decisive, blend_input<T>(rows, instances, ranges, no_background, image),
        last.const_data_ptr<int32_t>(), decisive.mutable_data_ptr<bool>());
  });
  return decisive;
}

void check_moments(const Tensor& value, const Tensor& gradient, const Tensor& mean, const Tensor& square) {
  for (const Tensor* t : {&gradient, &mean, &square})
    TORCH_CHECK(t->sizes() == value.sizes() && t->scalar_type() == value.scalar_type() && t->device() == value.device(),
                "gradient and moments must have the shape, dtype and device of the parameter, ", value.sizes(), " ",
                value.scalar_type(), " on ", value.device(), ", got ", t->sizes(), " ", t->scalar_type(), " on ",
                t->device());
  TORCH_CHECK(value.is_contiguous() && mean.is_contiguous() && square.is_contiguous(),
              "parameter and moments must be contiguous");
}

// The guard of a step (launch.h). `stopped` (1) int64 needs a loss of the parameters' dtype.
template <class T>
gs::StepGuard<T> step_guard(const Tensor& value, const MaybeTensor& loss, const MaybeTensor& stopped,
                            int64_t iteration) {
  if (!stopped) return {};
  TORCH_CHECK(
      loss && loss->numel() == 1 && loss->scalar_type() == value.scalar_type() && loss->device() == value.device(),
      "a guarded step needs the loss, one ", value.scalar_type(), " on ", value.device());
  TORCH_CHECK(stopped->numel() == 1 && stopped->scalar_type() == at::kLong && stopped->device() == value.device(),
              "stopped must be one int64 on ", value.device(), ", got ", stopped->sizes(), " ", stopped->scalar_type(),
              " on ", stopped->device());
  TORCH_CHECK(iteration > 0, "iterations of guarded steps count from 1, got ", iteration);
  return {loss->const_data_ptr<T>(), stopped->mutable_data_ptr<int64_t>(), iteration};
}

// One step of every parameter, in one launch on a GPU. Each counter is advanced first, as torch's are, also where the
// guard holds the step back.
void adam_op(at::TensorList values, at::TensorList gradients, at::TensorList means, at::TensorList squares,
             at::TensorList steps, at::ArrayRef<double> rates, double beta1, double beta2, double eps,
             at::IntArrayRef columns, const MaybeTensor& loss, const MaybeTensor& stopped, int64_t iteration) {
  const size_t n = values.size();
  for (size_t size : {gradients.size(), means.size(), squares.size(), steps.size(), rates.size(), columns.size()})
    TORCH_CHECK(size == n, "every list must have an entry for each of the ", n, " parameters, got ", size);
  if (n == 0) return;
  const Tensor& first = values[0];
  with_scalar(first.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    std::vector<gs::AdamInput<T>> inputs;
    std::vector<Tensor> contiguous;  // keeps the gradients' memory until the call is over
    for (size_t i = 0; i < n; ++i) {
      const Tensor& value = values[i];
      TORCH_CHECK(value.scalar_type() == first.scalar_type() && value.device() == first.device(),
                  "all parameters must have one dtype and device");
      check_moments(value, gradients[i], means[i], squares[i]);
      const Tensor& step = steps[i];
      TORCH_CHECK(step.is_cpu() && step.numel() == 1 && step.scalar_type() == at::kFloat,
                  "a step counter must be one float32 on the CPU, got ", step.sizes(), " ", step.scalar_type(), " on ",
                  step.device());
      const int64_t rows = value.dim() > 0 ? value.size(0) : 1, row = rows ? value.numel() / rows : 0;
      TORCH_CHECK(rows == 0 || columns[i] <= row, "columns must be at most ", row, ", got ", columns[i]);
      contiguous.push_back(gradients[i].contiguous());
      inputs.push_back({value.mutable_data_ptr<T>(), contiguous.back().template const_data_ptr<T>(),
                        means[i].mutable_data_ptr<T>(), squares[i].mutable_data_ptr<T>(), rows, row,
                        columns[i] < 0 ? row : columns[i], rates[i], beta1, beta2, eps,
                        double(*step.const_data_ptr<float>()) + 1});
    }
    RUN(T, first, adam, inputs.data(), int64_t(n), step_guard<T>(first, loss, stopped, iteration));
  });
  for (const Tensor& step : steps) *step.mutable_data_ptr<float>() += 1;
}

void sparse_adam_op(Tensor& value, const Tensor& gradient, Tensor& mean, Tensor& square, const Tensor& visible,
                    double lr, double beta1, double beta2, double eps, int64_t columns, const MaybeTensor& loss,
                    const MaybeTensor& stopped, int64_t iteration) {
  check_moments(value, gradient, mean, square);
  const int64_t rows = value.dim() > 0 ? value.size(0) : 1;
  TORCH_CHECK(visible.dim() == 1 && visible.size(0) == rows && visible.scalar_type() == at::kBool &&
                  visible.device() == value.device(),
              "visible must be (", rows, ") bool on ", value.device(), ", got ", visible.sizes(), " ",
              visible.scalar_type(), " on ", visible.device());
  if (value.numel() == 0) return;
  const int64_t row = value.numel() / rows;
  TORCH_CHECK(columns <= row, "columns must be at most ", row, ", got ", columns);
  const Tensor g = gradient.contiguous(), mask = visible.contiguous();
  with_scalar(value.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    gs::AdamInput<T> in{};
    in.value = value.mutable_data_ptr<T>(), in.gradient = g.const_data_ptr<T>();
    in.mean = mean.mutable_data_ptr<T>(), in.square = square.mutable_data_ptr<T>();
    in.rows = rows, in.row = row, in.columns = columns < 0 ? row : columns;
    in.lr = lr, in.beta1 = beta1, in.beta2 = beta2, in.eps = eps;
    RUN(T, value, sparse_adam, in, mask.const_data_ptr<bool>(), step_guard<T>(value, loss, stopped, iteration));
  });
}

void observe_op(Tensor& max_radii, Tensor& gradient_sums, Tensor& views, const Tensor& radii, const Tensor& gradient) {
  const int64_t n = radii.numel();
  for (const Tensor* t : {&max_radii, &gradient_sums, &views}) {
    TORCH_CHECK(t->numel() == n && t->scalar_type() == at::kFloat && t->device() == radii.device(),
                "statistics must be ", n, " float32 on ", radii.device(), ", got ", t->sizes(), " ", t->scalar_type(),
                " on ", t->device());
    TORCH_CHECK(t->is_contiguous(), "statistics must be contiguous");
  }
  TORCH_CHECK(radii.scalar_type() == at::kInt, "radii must be int32, got ", radii.scalar_type());
  TORCH_CHECK(gradient.dim() == 2 && gradient.size(0) == n && gradient.size(1) == 3 &&
                  gradient.scalar_type() == at::kFloat && gradient.device() == radii.device(),
              "the gradient must be (", n, ", 3) float32 on ", radii.device(), ", got ", gradient.sizes(), " ",
              gradient.scalar_type(), " on ", gradient.device());
  const Tensor pixels = radii.contiguous(), rows = gradient.contiguous();
  const gs::ObserveInput in{n,
                            max_radii.mutable_data_ptr<float>(),
                            gradient_sums.mutable_data_ptr<float>(),
                            views.mutable_data_ptr<float>(),
                            pixels.const_data_ptr<int32_t>(),
                            rows.const_data_ptr<float>()};
#ifdef GS_CUDA
  if (radii.is_cuda()) {
    gs::TorchQueue queue(radii.device());
    return gs::cuda::observe(queue.queue(), in);
  }
#endif
  gs::observe(gs::torch_executor(), in);
}

}  // namespace

TORCH_LIBRARY(diff_gaussian_rasterization, m) {
  m.def("project(" SCENE_SCHEMA ") -> (Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, Tensor radii)");
  m.def(
      "bin(Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, int height, int width, bool train) -> "
      "(Tensor instances, Tensor ranges, Tensor splat_slots, Tensor slots)");
  m.def(
      "blend(Tensor splats, Tensor instances, Tensor ranges, Tensor background, int height, int width, "
      "bool inverse_depth, bool train) -> (Tensor color, Tensor transmittance, Tensor inverse_depth, Tensor last)");
  m.def("blend_vjp(" BACKWARD_SCHEMA ") -> Tensor moments");
  m.def("project_vjp(" SCENE_SCHEMA ", Tensor tile_counts, Tensor moments, bool[9] wanted) -> " GRADIENTS_SCHEMA);
  m.def("rasterize(Tensor means2d, " SCENE_SCHEMA
        ", Tensor background, bool inverse_depth, bool train) -> (Tensor color, Tensor transmittance, "
        "Tensor inverse_depth, Tensor radii, Tensor splats, Tensor tile_counts, Tensor instances, "
        "Tensor ranges, Tensor splat_slots, Tensor slots, Tensor last)");
  m.def("rasterize_vjp(" SCENE_SCHEMA ", " BACKWARD_SCHEMA
        ", Tensor tile_counts, bool[9] wanted) -> " GRADIENTS_SCHEMA);
  m.def("mark_visible(Tensor means, Tensor view) -> Tensor");
  m.def("decisive(Tensor splats, Tensor instances, Tensor ranges, Tensor last) -> Tensor");
  m.def(
      "adam_(Tensor(a!)[] values, Tensor[] gradients, Tensor(b!)[] means, Tensor(c!)[] squares, Tensor(d!)[] steps, "
      "float[] rates, float beta1, float beta2, float eps, int[] columns, Tensor? loss=None, Tensor(e!)? stopped=None, "
      "int iteration=0) -> ()");
  m.def(
      "sparse_adam_(Tensor(a!) value, Tensor gradient, Tensor(b!) mean, Tensor(c!) square, Tensor visible, float lr, "
      "float beta1, float beta2, float eps, int columns=-1, Tensor? loss=None, Tensor(d!)? stopped=None, "
      "int iteration=0) -> ()");
  m.def(
      "observe_(Tensor(a!) max_radii, Tensor(b!) gradient_sums, Tensor(c!) views, Tensor radii, Tensor gradient) "
      "-> ()");
}

#define REGISTER(device)                                       \
  TORCH_LIBRARY_IMPL(diff_gaussian_rasterization, device, m) { \
    m.impl("project", &project_op);                            \
    m.impl("bin", &bin_op);                                    \
    m.impl("blend", &blend_op);                                \
    m.impl("blend_vjp", &blend_vjp_op);                        \
    m.impl("project_vjp", &project_vjp_op);                    \
    m.impl("rasterize", &rasterize_op);                        \
    m.impl("rasterize_vjp", &rasterize_vjp_op);                \
    m.impl("mark_visible", &mark_visible_op);                  \
    m.impl("decisive", &decisive_op);                          \
    m.impl("adam_", &adam_op);                                 \
    m.impl("sparse_adam_", &sparse_adam_op);                   \
    m.impl("observe_", &observe_op);                           \
  }
REGISTER(CPU)
#ifdef GS_CUDA
REGISTER(CUDA)
#endif
