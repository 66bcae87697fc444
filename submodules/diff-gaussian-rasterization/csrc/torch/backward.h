#pragma once
// What a backward takes, as tensors: what the forward has kept, the gradients of the image, or gradient rows.
#include "scene.h"

#define SOURCE_SCHEMA \
  "Tensor[] source, Tensor? grad_color=None, Tensor? grad_transmittance=None, Tensor? grad_inverse_depth=None"
#define SOURCE_PARAMETERS                                                                    \
  List<Tensor> source, const MaybeTensor &grad_color, const MaybeTensor &grad_transmittance, \
      const MaybeTensor &grad_inverse_depth
#define SOURCE_ARGUMENTS source, grad_color, grad_transmittance, grad_inverse_depth

namespace gs::ops {

// What a forward keeps for its backward, in this order.
enum Kept {
  kSplats,
  kTileCounts,
  kInstances,
  kRanges,
  kSplatSlots,
  kSlots,
  kLast,
  kLayers,
  kBackground,
  kTransmittance,
  kKept
};

// The ops of single stages take these from their callers. Of values only the ends of lists are checked, and only on the
// CPU, as reading one from a GPU waits for it. Other indices are the caller's concern.
void check_splats(const Tensor& splats);
void check_lists(const Tensor& instances, const Tensor& ranges, const Tensor& splats, gs::Image image);
void check_counts(const Tensor& tile_counts, int64_t count, Device device);
// The size of the image whose `last` this is.
gs::Image image_of(const Tensor& last, const Tensor& splats);
Tensor background_like(const Tensor& background, const Tensor& splats, int64_t channels = 3);

// Refuses splats on the rays of a lens, too: these ops have no lens.
void check_staged(const Tensor& splats);

// What splats are, by their values.
gs::Rays rays_of(const Tensor& splats);

// Values of a gradient row, with those of absolute gradients or without.
int64_t row_values(bool absolute, gs::Rays rays);

template <class T>
gs::BlendInput<T> blend_input(const Tensor& splats, const Tensor& instances, const Tensor& ranges,
                              const Tensor& background, gs::Image image, const Tensor& table) {
  return {read<T>(splats), read<int32_t>(instances), read<int64_t>(ranges), read<T>(background),
          image,           instances.size(0),        rays_of(splats),       table.defined() ? read<T>(table) : nullptr};
}

// Gradient rows, which a backend allocates once it knows their number, and the number of each splat's.
class KeptRows {
 public:
  Tensor rows, counts;

  KeptRows(const Tensor& splats, bool absolute)
      : counts(empty<int32_t>({splats.size(0)}, splats)), splats_(splats), absolute_(absolute) {}

  template <class T>
  gs::RowMemory<T> memory() {
    const auto take = [](void* context, int64_t count) {
      auto& to = *static_cast<KeptRows*>(context);
      to.rows = empty({count, row_values(to.absolute_, rays_of(to.splats_))}, to.splats_);
      return write<T>(to.rows);
    };
    return {take, this, write<int32_t>(counts), absolute_};
  }

 private:
  Tensor splats_;
  bool absolute_;
};

// Owns the tensors that the gs::BlendInput and gs::BlendGradient of a backward point into. source: Kept. table: of
// gs::BlendInput, or undefined. channels: of the image; last: whether they are its last axis.
class BlendBackward {
 public:
  BlendBackward(SOURCE_PARAMETERS, const Tensor& table, int64_t channels = 3, bool last = false);

  const Tensor& splats() const { return kept_[kSplats]; }

  template <class T>
  gs::BlendInput<T> input() const {
    return blend_input<T>(kept_[kSplats], kept_[kInstances], kept_[kRanges], kept_[kBackground], image_, table_);
  }
  // absolute: gs::BlendGradient::absolute, if it is defined.
  template <class T>
  gs::BlendGradient<T> gradient(T* moments, const Tensor& absolute) const {
    const auto pointer = [](const Tensor& t) { return t.defined() ? read<T>(t) : nullptr; };
    return {splats().size(0),
            kept_[kInstances].size(0),
            kept_[kSlots].size(0),
            static_cast<const gs::SplatSlots*>(kept_[kSplatSlots].const_data_ptr()),
            read<T>(kept_[kTransmittance]),
            read<int32_t>(kept_[kLast]),
            read<T>(color_),
            pointer(depth_),
            pointer(alpha_),
            moments,
            kept_[kLayers].numel() ? read<T>(kept_[kLayers]) : nullptr,
            ahead(),
            absolute.defined() ? write<T>(absolute) : nullptr};
  }

 private:
  void check_lists_of_forward() const;
  void check_layers() const;
  Tensor plane(const MaybeTensor& t, Sizes sizes) const;

  std::array<Tensor, kKept> kept_;
  gs::Image image_;
  Tensor color_, alpha_, depth_, table_;
};

// Where the gradients of a scene come from: what a forward has kept (BlendBackward); or gradient rows, then `source` is
// splats, tile_counts, rows and counts, and there are no gradients of planes; or splats, tile_counts and their moments,
// which have no absolute gradients and take no step.
class GradientSource {
 public:
  // absolute: whether rows have the values of absolute gradients. lengths: whether these are asked for.
  GradientSource(const SceneTensors& scene, SOURCE_PARAMETERS, bool absolute, bool lengths);

  const Tensor& tile_counts() const { return tile_counts_; }

  // Lengths of absolute gradients are written to `lengths`, if it is defined, here and below.
  Tensor moments(const Tensor& lengths) const;
#ifdef GS_CUDA
  void vjp(const gs::Queue&, const gs::Scene<float>&, const Tensor& lengths, const gs::cuda::GradientMemory&) const;
  void step(const gs::Queue&, const gs::Scene<float>&, const Tensor& lengths, const gs::GaussianStep<float>&) const;
  void camera(const gs::Queue&, const gs::Scene<float>&, double* out) const;  // of gradient rows
#endif

 private:
  void take_rows(const SceneTensors& scene, List<Tensor> source, bool absolute, bool lengths);
  void check_sum() const;

  template <class T>
  gs::SplatRows<T> input() const {
    return {counts_.size(0), read<int32_t>(tile_counts_), read<int32_t>(counts_), read<T>(rows_), rows_.size(0),
            rays_of(splats_)};
  }
  template <class T>
  gs::RowSums<T> sums(T* moments, const Tensor& lengths) const {
    return {read<T>(splats_), image_, moments, lengths.defined() ? write<T>(lengths) : nullptr};
  }

  std::optional<BlendBackward> blend_;
  gs::Image image_;
  Tensor splats_, tile_counts_, rows_, counts_, moments_;
};

// Refuses a scene whose camera gets no gradient.
void check_camera_gradients(const SceneTensors& scene);

// Memory for the lengths of absolute gradients; undefined if they are not wanted.
Tensor absolute_like(const SceneTensors& scene, bool wanted);

// The gradients of a scene that are wanted. lengths: whether the third value of a row of means2d becomes the length of
// its absolute gradient, instead of 0.
Gradients vjp(const SceneTensors& scene, const GradientSource& source, bool lengths, const Wanted& wanted);

}  // namespace gs::ops
