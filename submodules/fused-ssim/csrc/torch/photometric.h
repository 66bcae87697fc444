#pragma once
// What the ops of the photometric loss share: checks, shapes, and the way back.
#include <ATen/ops/empty.h>
#include <torch/library.h>

#include "backend.h"
#include "gs/torch_executor.h"

#ifdef GS_CUDA
#include "gs/torch_queue.h"
#endif

namespace gs::ops {

// TypeError for Python's None, which arrives as an undefined tensor where the schema wants one.
inline void check_given(const at::Tensor& t, const char* name) {
  TORCH_CHECK_TYPE(t.defined(), name, " must be a tensor, got None");
}

inline void check_images(const at::Tensor& img1, const at::Tensor& img2, bool valid) {
  check_given(img1, "img1"), check_given(img2, "img2");
  TORCH_CHECK(img1.scalar_type() == at::kFloat || img1.scalar_type() == at::kDouble,
              "img1 must be float32 or float64, got ", img1.scalar_type());
  TORCH_CHECK(img2.scalar_type() == img1.scalar_type() || img2.scalar_type() == at::kByte, "img2 must be ",
              img1.scalar_type(), " like img1, or uint8, got ", img2.scalar_type());
  TORCH_CHECK(img1.dim() >= 2 && img1.numel() > 0 && img1.sizes() == img2.sizes(),
              "img1 and img2 must be images of the same shape (..., H, W), got ", img1.sizes(), " and ", img2.sizes());
  TORCH_CHECK(!valid || (img1.size(-1) >= 11 && img1.size(-2) >= 11), "valid needs 11 x 11 pixels or more, got ",
              img1.sizes());
}

template <class T>
gs::ImagePair<T> image_pair(const at::Tensor& img1, const at::Tensor& img2, bool clamp) {
  const int64_t height = img1.size(-2), width = img1.size(-1);
  return {img1.const_data_ptr<T>(),
          img2.const_data_ptr(),
          img2.scalar_type() == at::kByte,
          img1.numel() / (height * width),
          height,
          width,
          clamp};
}

// The shape of what a forward of some rows keeps for the backward: on the CPU the gradient of SSIM, on a GPU
// L1SsimCuda::maps.
inline at::DimVector kept_shape(const at::Tensor& img1, const gs::RowRange& rows) {
  if (!img1.is_cuda()) return at::DimVector(img1.sizes());
  const int64_t height = img1.size(-2), width = img1.size(-1);
  const gs::RowRange maps = gs::map_rows(rows, height);
  return {img1.numel() / (height * width), gs::map_strips(width), maps.end - maps.begin, gs::kMapRow};
}

inline gs::RowRange all_rows(const at::Tensor& img1) { return {0, img1.size(-2)}; }

// Memory for it, if there will be a backward.
inline at::Tensor empty_kept(const at::Tensor& img1, bool train) {
  return at::empty(train ? kept_shape(img1, all_rows(img1)) : at::DimVector{0}, img1.options());
}

template <class T>
inline at::Tensor scalar(T value, const at::TensorOptions& options) {
  at::Tensor out = at::empty({}, options);
  *out.mutable_data_ptr<T>() = value;
  return out;
}

// Calls run(T()) for the dtype of an image.
template <class Run>
auto with_scalar(const at::Tensor& image, const Run& run) {
  return image.scalar_type() == at::kFloat ? run(0.0f) : run(0.0);
}

struct Means {
  double l1, ssim;
};

template <class T>
T photometric_loss(const Means& means, double lambda) {
  return T(1 - lambda) * T(means.l1) + T(lambda) * (1 - T(means.ssim));
}

inline void check_kept(const at::Tensor& kept, const at::Tensor& img1, const gs::RowRange& rows) {
  check_given(kept, "kept");
  const at::DimVector wanted = kept_shape(img1, rows);
  TORCH_CHECK(kept.sizes() == at::IntArrayRef(wanted) && kept.scalar_type() == img1.scalar_type(), "kept must be ",
              at::IntArrayRef(wanted), " of ", img1.scalar_type(), ", as a forward with train = True gives it, got ",
              kept.sizes(), " of ", kept.scalar_type());
}

// Checks the gradient of a mean.
inline void check_scalar(const at::Tensor& grad, const at::Tensor& img1) {
  check_given(grad, "the gradient of a mean");
  TORCH_CHECK_TYPE(grad.scalar_type() == img1.scalar_type(), "the gradient of a mean must be ", img1.scalar_type(),
                   " like img1, got ", grad.scalar_type());
  TORCH_CHECK_VALUE(grad.numel() == 1, "the gradient of a mean must be a scalar, got ", grad.sizes());
}

// rows: null for all.
template <class T>
at::Tensor vjp(const at::Tensor& img1_, const at::Tensor& img2_, const at::Tensor& kept_, bool clamp, T grad_l1,
               T grad_ssim, const gs::RowRange* rows = nullptr) {
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous(), kept = kept_.contiguous();
  at::Tensor grad_img1 = at::empty(img1.sizes(), img1.options());
  const gs::L1SsimVjp<T> args{image_pair<T>(img1, img2, clamp),
                              kept.const_data_ptr<T>(),
                              double(grad_l1),
                              double(grad_ssim),
                              grad_img1.mutable_data_ptr<T>(),
                              rows};
  GS_DISPATCH(l1_ssim_vjp_cpu, args, gs::torch_executor());
  return grad_img1;
}

inline at::Tensor photometric_rows_vjp(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept,
                                       double lambda, const at::Tensor& grad_loss, const gs::RowRange* rows) {
  check_images(img1, img2, false);
  check_kept(kept, img1, rows ? *rows : all_rows(img1));
  check_scalar(grad_loss, img1);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const T grad = grad_loss.item<T>();
    return vjp<T>(img1, img2, kept, true, grad * T(1 - lambda), grad * -T(lambda), rows);
  });
}

#ifdef GS_CUDA
inline void check_images_cuda(const at::Tensor& img1, const at::Tensor& img2, bool valid) {
  check_images(img1, img2, valid);
  TORCH_CHECK(img1.scalar_type() == at::kFloat, "img1 must be float32 on a GPU, got ", img1.scalar_type());
  TORCH_CHECK(img1.device() == img2.device(), "img1 is on ", img1.device(), " and img2 on ", img2.device());
}

inline void check_on_cuda(const at::Tensor& gradient, const at::Tensor& img1) {
  TORCH_CHECK(gradient.device() == img1.device() && gradient.scalar_type() == at::kFloat,
              "the gradients must be float32 on ", img1.device(), " like img1, got ", gradient.scalar_type(), " on ",
              gradient.device());
}

inline at::Tensor vjp_on_cuda(const at::Tensor& img1_, const at::Tensor& img2_, const at::Tensor& kept_, bool clamp,
                              const at::Tensor& grad_l1, float l1_weight, const at::Tensor& grad_ssim,
                              float ssim_weight, const gs::RowRange* rows = nullptr) {
  check_images_cuda(img1_, img2_, false);
  check_kept(kept_, img1_, rows ? *rows : all_rows(img1_));
  check_on_cuda(kept_, img1_);
  for (const at::Tensor& grad : {grad_l1, grad_ssim}) {
    check_scalar(grad, img1_);
    check_on_cuda(grad, img1_);
  }
  gs::TorchQueue queue(img1_.device());
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  const bool aligned = reinterpret_cast<uintptr_t>(kept_.const_data_ptr()) % 16 == 0;  // else a view of the caller's
  const at::Tensor kept = aligned ? kept_.contiguous() : kept_.clone(at::MemoryFormat::Contiguous);
  at::Tensor grad_img1 = at::empty(img1.sizes(), img1.options());
  gs::l1_ssim_vjp_cuda(
      {image_pair<float>(img1, img2, clamp), kept.const_data_ptr<float>(), grad_l1.const_data_ptr<float>(),
       grad_ssim.const_data_ptr<float>(), grad_img1.mutable_data_ptr<float>(), l1_weight, ssim_weight, nullptr, rows},
      queue.queue());
  return grad_img1;
}
#endif

}  // namespace gs::ops
