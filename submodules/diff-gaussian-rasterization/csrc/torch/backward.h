#pragma once
// What a forward hands to its backward, as tensors.
#include "tensors.h"

#define BACKWARD_SCHEMA                                                                                   \
  "Tensor splats, Tensor instances, Tensor ranges, Tensor splat_slots, Tensor slots, "                    \
  "Tensor background, Tensor last, Tensor transmittance, Tensor grad_color, Tensor? grad_transmittance, " \
  "Tensor? grad_inverse_depth"
#define BACKWARD_PARAMETERS                                                                                            \
  const Tensor &splats, const Tensor &instances, const Tensor &ranges, const Tensor &splat_slots, const Tensor &slots, \
      const Tensor &background, const Tensor &last, const Tensor &transmittance, const Tensor &grad_color,             \
      const MaybeTensor &grad_transmittance, const MaybeTensor &grad_inverse_depth
#define BACKWARD_ARGUMENTS                                                                                        \
  splats, instances, ranges, splat_slots, slots, background, last, transmittance, grad_color, grad_transmittance, \
      grad_inverse_depth

namespace gs::ops {

// The ops of single stages take these from their callers. Of values only the ends of lists are checked, and only on the
// CPU, as reading one from a GPU waits for it. Other indices are the caller's concern.
void check_splats(const Tensor& splats);
void check_lists(const Tensor& instances, const Tensor& ranges, const Tensor& splats, gs::Image image);
void check_counts(const Tensor& tile_counts, int64_t count, Device device);
// What projection gives to binning.
void check_projected(const Tensor& splats, const Tensor& depths, const Tensor& rects, const Tensor& tile_counts);
// The size of the image whose `last` this is.
gs::Image image_of(const Tensor& last, const Tensor& splats);
Tensor background_like(const Tensor& background, const Tensor& splats);

template <class T>
gs::BlendInput<T> blend_input(const Tensor& splats, const Tensor& instances, const Tensor& ranges,
                              const Tensor& background, gs::Image image) {
  return {read<T>(splats), read<int32_t>(instances), read<int64_t>(ranges), read<T>(background),
          image,           instances.size(0)};
}

// Owns the tensors that the gs::BlendInput and gs::BlendGradient of a backward point into.
class BlendBackward {
 public:
  BlendBackward(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& splat_slots,
                const Tensor& slots, const Tensor& background, const Tensor& last, const Tensor& transmittance,
                const Tensor& grad_color, const MaybeTensor& grad_transmittance, const MaybeTensor& grad_inverse_depth)
      : image_(checked(splats, instances, ranges, splat_slots, slots, last, transmittance, grad_color)),
        splats_(aligned(splats, 2)),
        instances_(packed(instances)),
        ranges_(packed(ranges)),
        splat_slots_(packed(splat_slots)),
        slot_count_(slots.size(0)),
        background_(background_like(background, splats)),
        last_(packed(last)),
        transmittance_(packed(transmittance)),
        color_(plane(grad_color, 3)),
        alpha_(plane(grad_transmittance, 1)),
        depth_(plane(grad_inverse_depth, 1)) {}

  const Tensor& splats() const { return splats_; }

  // Takes the forward's layers. Without them, the backward makes its own.
  void take_layers(const Tensor& layers);

  template <class T>
  gs::BlendInput<T> input() const {
    return blend_input<T>(splats_, instances_, ranges_, background_, image_);
  }
  // absolute: gs::BlendGradient::absolute, if it is defined.
  template <class T>
  gs::BlendGradient<T> gradient(T* moments, const Tensor& absolute) const {
    return {splats_.size(0),
            instances_.size(0),
            slot_count_,
            static_cast<const gs::SplatSlots*>(splat_slots_.const_data_ptr()),
            read<T>(transmittance_),
            read<int32_t>(last_),
            read<T>(color_),
            depth_.defined() ? read<T>(depth_) : nullptr,
            alpha_.defined() ? read<T>(alpha_) : nullptr,
            moments,
            layers_.defined() && layers_.numel() ? read<T>(layers_) : nullptr,
            ahead(),
            absolute.defined() ? write<T>(absolute) : nullptr};
  }

 private:
  // Checks all but the planes of gradients; returns the size of the image.
  static gs::Image checked(const Tensor& splats, const Tensor& instances, const Tensor& ranges,
                           const Tensor& splat_slots, const Tensor& slots, const Tensor& last,
                           const Tensor& transmittance, const Tensor& grad_color);
  Tensor plane(const MaybeTensor& t, int64_t channels) const;

  gs::Image image_;
  Tensor splats_, instances_, ranges_, splat_slots_;
  int64_t slot_count_;
  Tensor background_, last_, transmittance_;
  Tensor color_, alpha_, depth_, layers_;
};

Tensor blend_vjp(const BlendBackward& in, const Tensor& absolute = {});

// Memory for the lengths of absolute gradients; undefined if they are not wanted.
Tensor absolute_like(const Tensor& splats, bool wanted);

}  // namespace gs::ops
