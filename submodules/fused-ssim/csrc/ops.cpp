#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <torch/library.h>

#include <tuple>

#include "gs/torch_executor.h"
#include "launch.h"

#ifdef GS_CUDA
#include "gs/torch_queue.h"
#endif

namespace {

void check_images(const at::Tensor& img1, const at::Tensor& img2, bool valid) {
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
gs::ImagePair<T> image_pair(const at::Tensor& img1, const at::Tensor& img2) {
  const int64_t height = img1.size(-2), width = img1.size(-1);
  return {img1.const_data_ptr<T>(),
          img2.const_data_ptr(),
          img2.scalar_type() == at::kByte,
          img1.numel() / (height * width),
          height,
          width};
}

std::tuple<at::Tensor, at::Tensor, at::Tensor> l1_ssim(const at::Tensor& img1_, const at::Tensor& img2_, bool valid,
                                                       bool train) {
  check_images(img1_, img2_, valid);
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  at::Tensor gradient = train ? at::empty(img1.sizes(), img1.options()) : at::empty({0}, img1.options());
  const auto run = [&](auto zero) {
    using T = decltype(zero);
    double l1 = 0, ssim = 0;
    const gs::L1Ssim<T> args{image_pair<T>(img1, img2), valid, &l1, &ssim,
                             train ? gradient.mutable_data_ptr<T>() : nullptr};
    GS_DISPATCH(l1_ssim_cpu, args, gs::torch_executor());
    at::Tensor l1_out = at::empty({}, img1.options()), ssim_out = at::empty({}, img1.options());
    *l1_out.mutable_data_ptr<T>() = T(l1);
    *ssim_out.mutable_data_ptr<T>() = T(ssim);
    return std::make_tuple(l1_out, ssim_out, gradient);
  };
  return img1.scalar_type() == at::kFloat ? run(0.0f) : run(0.0);
}

void check_ssim_gradient(const at::Tensor& ssim_gradient, const at::Tensor& img1) {
  TORCH_CHECK(ssim_gradient.sizes() == img1.sizes() && ssim_gradient.scalar_type() == img1.scalar_type(),
              "ssim_gradient must be like img1, got ", ssim_gradient.sizes(), " and ", img1.sizes(),
              ": it is kept by l1_ssim with train = True only");
}

at::Tensor l1_ssim_vjp(const at::Tensor& img1_, const at::Tensor& img2_, const at::Tensor& ssim_gradient_,
                       const at::Tensor& grad_l1, const at::Tensor& grad_ssim) {
  check_images(img1_, img2_, false);
  check_ssim_gradient(ssim_gradient_, img1_);
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous(), ssim_gradient = ssim_gradient_.contiguous();
  at::Tensor grad_img1 = at::empty(img1.sizes(), img1.options());
  const auto run = [&](auto zero) {
    using T = decltype(zero);
    const gs::L1SsimVjp<T> args{image_pair<T>(img1, img2), ssim_gradient.const_data_ptr<T>(), grad_l1.item<double>(),
                                grad_ssim.item<double>(), grad_img1.mutable_data_ptr<T>()};
    GS_DISPATCH(l1_ssim_vjp_cpu, args, gs::torch_executor());
  };
  img1.scalar_type() == at::kFloat ? run(0.0f) : run(0.0);
  return grad_img1;
}

#ifdef GS_CUDA
void check_images_cuda(const at::Tensor& img1, const at::Tensor& img2, bool valid) {
  check_images(img1, img2, valid);
  TORCH_CHECK(img1.scalar_type() == at::kFloat, "img1 must be float32 on a GPU, got ", img1.scalar_type());
  TORCH_CHECK(img1.device() == img2.device(), "img1 is on ", img1.device(), " and img2 on ", img2.device());
}

std::tuple<at::Tensor, at::Tensor, at::Tensor> l1_ssim_on_cuda(const at::Tensor& img1_, const at::Tensor& img2_,
                                                               bool valid, bool train) {
  check_images_cuda(img1_, img2_, valid);
  gs::TorchQueue queue(img1_.device());
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  at::Tensor l1 = at::empty({}, img1.options()), ssim = at::empty({}, img1.options());
  at::Tensor gradient = train ? at::empty(img1.sizes(), img1.options()) : at::empty({0}, img1.options());
  gs::l1_ssim_cuda({image_pair<float>(img1, img2), valid, l1.mutable_data_ptr<float>(), ssim.mutable_data_ptr<float>(),
                    train ? gradient.mutable_data_ptr<float>() : nullptr},
                   queue.queue());
  return {l1, ssim, gradient};
}

at::Tensor l1_ssim_vjp_on_cuda(const at::Tensor& img1_, const at::Tensor& img2_, const at::Tensor& ssim_gradient_,
                               const at::Tensor& grad_l1, const at::Tensor& grad_ssim) {
  check_images_cuda(img1_, img2_, false);
  check_ssim_gradient(ssim_gradient_, img1_);
  for (const at::Tensor& other : {ssim_gradient_, grad_l1, grad_ssim})
    TORCH_CHECK(other.device() == img1_.device() && other.scalar_type() == at::kFloat,
                "the gradients must be float32 on ", img1_.device(), " like img1, got ", other.scalar_type(), " on ",
                other.device());
  TORCH_CHECK(grad_l1.numel() == 1 && grad_ssim.numel() == 1, "grad_l1 and grad_ssim must be scalars");
  gs::TorchQueue queue(img1_.device());
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous(), ssim_gradient = ssim_gradient_.contiguous();
  at::Tensor grad_img1 = at::empty(img1.sizes(), img1.options());
  gs::l1_ssim_vjp_cuda(
      {image_pair<float>(img1, img2), ssim_gradient.const_data_ptr<float>(), grad_l1.const_data_ptr<float>(),
       grad_ssim.const_data_ptr<float>(), grad_img1.mutable_data_ptr<float>()},
      queue.queue());
  return grad_img1;
}
#endif

}  // namespace

TORCH_LIBRARY(fused_ssim, m) {
  m.def("l1_ssim(Tensor img1, Tensor img2, bool valid, bool train) -> (Tensor l1, Tensor ssim, Tensor ssim_gradient)");
  m.def(
      "l1_ssim_vjp(Tensor img1, Tensor img2, Tensor ssim_gradient, Tensor grad_l1, Tensor grad_ssim)"
      " -> Tensor grad_img1");
}

TORCH_LIBRARY_IMPL(fused_ssim, CPU, m) {
  m.impl("l1_ssim", &l1_ssim);
  m.impl("l1_ssim_vjp", &l1_ssim_vjp);
}

#ifdef GS_CUDA
TORCH_LIBRARY_IMPL(fused_ssim, CUDA, m) {
  m.impl("l1_ssim", &l1_ssim_on_cuda);
  m.impl("l1_ssim_vjp", &l1_ssim_vjp_on_cuda);
}
#endif
