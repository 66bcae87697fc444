#pragma once
// What the ops of the photometric loss share: checks, shapes, and the way back.
#include "backend.h"
#include "gs/torch_executor.h"
#include "gs/torch_operators.h"
#include "gs/torch_tensor.h"

#ifdef GS_CUDA
#include "gs/torch_queue.h"
#endif

namespace gs::ops {

inline void check_images(const Tensor& img1, const Tensor& img2, bool valid) {
  check_given(img1, "img1"), check_given(img2, "img2");
  GS_CHECK(is_floating(img1.scalar_type()), "img1 must be float32 or float64, got ", img1.scalar_type());
  GS_CHECK(img2.scalar_type() == img1.scalar_type() || img2.scalar_type() == ScalarType::Byte, "img2 must be ",
           img1.scalar_type(), " like img1, or uint8, got ", img2.scalar_type());
  GS_CHECK(img1.dim() >= 2 && img1.numel() > 0 && same(img1.sizes(), img2.sizes()),
           "img1 and img2 must be images of the same shape (..., H, W), got ", img1.sizes(), " and ", img2.sizes());
  GS_CHECK(!valid || (img1.size(-1) >= 11 && img1.size(-2) >= 11), "valid needs 11 x 11 pixels or more, got ",
           img1.sizes());
}

template <class T>
gs::ImagePair<T> image_pair(const Tensor& img1, const Tensor& img2, bool clamp) {
  const int64_t height = img1.size(-2), width = img1.size(-1);
  return {read<T>(img1),
          img2.const_data_ptr(),
          img2.scalar_type() == ScalarType::Byte,
          img1.numel() / (height * width),
          height,
          width,
          clamp};
}

// The shape of what a forward of some rows keeps for the backward: on the CPU the gradient of SSIM, on a GPU
// L1SsimCuda::maps.
inline Shape kept_shape(const Tensor& img1, const gs::RowRange& rows) {
  if (!img1.is_cuda()) return img1.sizes().vec();
  const int64_t height = img1.size(-2), width = img1.size(-1);
  const gs::RowRange maps = gs::map_rows(rows, height);
  return {img1.numel() / (height * width), gs::map_strips(width), maps.end - maps.begin, gs::kMapRow};
}

inline gs::RowRange all_rows(const Tensor& img1) { return {0, img1.size(-2)}; }

// Memory for it, if there will be a backward.
inline Tensor empty_kept(const Tensor& img1, bool train) {
  return empty(train ? kept_shape(img1, all_rows(img1)) : Shape{0}, img1);
}

// Calls run(T()) for the dtype of an image.
template <class Run>
auto with_scalar(const Tensor& image, const Run& run) {
  return image.scalar_type() == ScalarType::Float ? run(0.0f) : run(0.0);
}

struct Means {
  double l1, ssim;
};

template <class T>
T photometric_loss(const Means& means, double lambda) {
  return T(1 - lambda) * T(means.l1) + T(lambda) * (1 - T(means.ssim));
}

inline void check_kept(const Tensor& kept, const Tensor& img1, const gs::RowRange& rows) {
  check_given(kept, "kept");
  const Shape wanted = kept_shape(img1, rows);
  GS_CHECK(same(kept.sizes(), wanted) && kept.scalar_type() == img1.scalar_type(), "kept must be ", wanted, " of ",
           img1.scalar_type(), ", as a forward with train = True gives it, got ", kept.sizes(), " of ",
           kept.scalar_type());
}

// Checks the gradient of a mean.
inline void check_scalar(const Tensor& grad, const Tensor& img1) {
  check_given(grad, "the gradient of a mean");
  GS_CHECK_TYPE(grad.scalar_type() == img1.scalar_type(), "the gradient of a mean must be ", img1.scalar_type(),
                " like img1, got ", grad.scalar_type());
  GS_CHECK_VALUE(grad.numel() == 1, "the gradient of a mean must be a scalar, got ", grad.sizes());
}

// rows: null for all.
template <class T>
Tensor vjp(const Tensor& img1_, const Tensor& img2_, const Tensor& kept_, bool clamp, T grad_l1, T grad_ssim,
           const gs::RowRange* rows = nullptr) {
  const Tensor img1 = packed(img1_), img2 = packed(img2_), kept = packed(kept_);
  Tensor grad_img1 = empty(img1.sizes(), img1);
  const gs::L1SsimVjp<T> args{
      image_pair<T>(img1, img2, clamp), read<T>(kept), double(grad_l1), double(grad_ssim), write<T>(grad_img1), rows};
  GS_DISPATCH(l1_ssim_vjp_cpu, args, gs::torch_executor());
  return grad_img1;
}

inline Tensor photometric_rows_vjp(const Tensor& img1, const Tensor& img2, const Tensor& kept, bool clamp,
                                   double lambda, const Tensor& grad_loss, const gs::RowRange* rows) {
  check_images(img1, img2, false);
  check_kept(kept, img1, rows ? *rows : all_rows(img1));
  check_scalar(grad_loss, img1);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const T grad = value_of<T>(grad_loss);
    return vjp<T>(img1, img2, kept, clamp, grad * T(1 - lambda), grad * -T(lambda), rows);
  });
}

#ifdef GS_CUDA
inline void check_images_cuda(const Tensor& img1, const Tensor& img2, bool valid) {
  check_images(img1, img2, valid);
  GS_CHECK(img1.scalar_type() == ScalarType::Float, "img1 must be float32 on a GPU, got ", img1.scalar_type());
  GS_CHECK(img1.device() == img2.device(), "img1 is on ", img1.device(), " and img2 on ", img2.device());
}

inline void check_on_cuda(const Tensor& gradient, const Tensor& img1) {
  GS_CHECK(gradient.device() == img1.device() && gradient.scalar_type() == ScalarType::Float,
           "the gradients must be float32 on ", img1.device(), " like img1, got ", gradient.scalar_type(), " on ",
           gradient.device());
}

inline Tensor vjp_on_cuda(const Tensor& img1_, const Tensor& img2_, const Tensor& kept_, bool clamp,
                          const Tensor& grad_l1, float l1_weight, const Tensor& grad_ssim, float ssim_weight,
                          const gs::RowRange* rows = nullptr) {
  check_images_cuda(img1_, img2_, false);
  check_kept(kept_, img1_, rows ? *rows : all_rows(img1_));
  check_on_cuda(kept_, img1_);
  for (const Tensor* grad : {&grad_l1, &grad_ssim}) {
    check_scalar(*grad, img1_);
    check_on_cuda(*grad, img1_);
  }
  gs::TorchQueue queue(img1_.device());
  const Tensor img1 = packed(img1_), img2 = packed(img2_);
  const bool aligned = reinterpret_cast<uintptr_t>(kept_.const_data_ptr()) % 16 == 0;  // else a view of the caller's
  const Tensor kept = aligned ? packed(kept_) : torch::stable::clone(packed(kept_));
  Tensor grad_img1 = empty(img1.sizes(), img1);
  gs::l1_ssim_vjp_cuda({image_pair<float>(img1, img2, clamp), read<float>(kept), read<float>(grad_l1),
                        read<float>(grad_ssim), write<float>(grad_img1), l1_weight, ssim_weight, nullptr, rows},
                       queue.queue());
  return grad_img1;
}
#endif

}  // namespace gs::ops
