// The ops of the photometric loss, and of compositing: checks, memory and the way to a backend.
#include <tuple>

#include "photometric.h"

namespace gs::ops {
namespace {

template <class T>
Means means_of(const gs::ImagePair<T>& images, bool valid, at::Tensor& gradient) {
  Means means{};
  const gs::L1Ssim<T> args{images, valid, &means.l1, &means.ssim,
                           gradient.numel() ? gradient.mutable_data_ptr<T>() : nullptr};
  GS_DISPATCH(l1_ssim_cpu, args, gs::torch_executor());
  return means;
}

using Tensors3 = std::tuple<at::Tensor, at::Tensor, at::Tensor>;

Tensors3 l1_ssim(const at::Tensor& img1_, const at::Tensor& img2_, bool valid, bool train) {
  check_images(img1_, img2_, valid);
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  at::Tensor gradient = empty_kept(img1, train);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const Means means = means_of(image_pair<T>(img1, img2, false), valid, gradient);
    return Tensors3(scalar(T(means.l1), img1.options()), scalar(T(means.ssim), img1.options()), gradient);
  });
}

Tensors3 photometric(const at::Tensor& img1_, const at::Tensor& img2_, double lambda, bool train) {
  check_images(img1_, img2_, false);
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  at::Tensor gradient = empty_kept(img1, train);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const Means means = means_of(image_pair<T>(img1, img2, true), false, gradient);
    return Tensors3(scalar(photometric_loss<T>(means, lambda), img1.options()), scalar(T(means.l1), img1.options()),
                    gradient);
  });
}

at::Tensor l1_ssim_vjp(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept,
                       const at::Tensor& grad_l1, const at::Tensor& grad_ssim) {
  check_images(img1, img2, false);
  check_kept(kept, img1, all_rows(img1));
  check_scalar(grad_l1, img1), check_scalar(grad_ssim, img1);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    return vjp<T>(img1, img2, kept, false, grad_l1.item<T>(), grad_ssim.item<T>());
  });
}

at::Tensor photometric_vjp(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept, double lambda,
                           const at::Tensor& grad_loss) {
  return photometric_rows_vjp(img1, img2, kept, lambda, grad_loss, nullptr);
}

#ifdef GS_CUDA
Tensors3 l1_ssim_on_cuda(const at::Tensor& img1_, const at::Tensor& img2_, bool valid, bool train) {
  check_images_cuda(img1_, img2_, valid);
  gs::TorchQueue queue(img1_.device());
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  at::Tensor l1 = at::empty({}, img1.options()), ssim = at::empty({}, img1.options());
  at::Tensor kept = empty_kept(img1, train);
  gs::l1_ssim_cuda({image_pair<float>(img1, img2, false), valid, l1.mutable_data_ptr<float>(),
                    ssim.mutable_data_ptr<float>(), train ? kept.mutable_data_ptr<float>() : nullptr},
                   queue.queue());
  return {l1, ssim, kept};
}

Tensors3 photometric_on_cuda(const at::Tensor& img1_, const at::Tensor& img2_, double lambda, bool train) {
  check_images_cuda(img1_, img2_, false);
  gs::TorchQueue queue(img1_.device());
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  at::Tensor loss = at::empty({}, img1.options()), l1 = at::empty({}, img1.options());
  at::Tensor kept = empty_kept(img1, train);
  gs::l1_ssim_cuda({image_pair<float>(img1, img2, true), false, l1.mutable_data_ptr<float>(), nullptr,
                    train ? kept.mutable_data_ptr<float>() : nullptr, loss.mutable_data_ptr<float>(), float(1 - lambda),
                    float(lambda)},
                   queue.queue());
  return {loss, l1, kept};
}

at::Tensor l1_ssim_vjp_on_cuda(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept,
                               const at::Tensor& grad_l1, const at::Tensor& grad_ssim) {
  return vjp_on_cuda(img1, img2, kept, false, grad_l1, 1, grad_ssim, 1);
}

at::Tensor photometric_vjp_on_cuda(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept,
                                   double lambda, const at::Tensor& grad_loss) {
  return vjp_on_cuda(img1, img2, kept, true, grad_loss, float(1 - lambda), grad_loss, -float(lambda));
}

#endif

at::Tensor composite(const at::Tensor& picture_, const at::Tensor& background_) {
  check_given(picture_, "the picture"), check_given(background_, "the background");
  TORCH_CHECK(picture_.dim() == 3 && picture_.size(0) == 4 && picture_.scalar_type() == at::kByte,
              "the picture must be (4, H, W) uint8, got ", picture_.sizes(), " ", picture_.scalar_type());
  TORCH_CHECK(background_.numel() == 3 && background_.scalar_type() == at::kFloat,
              "the background must be 3 float32, got ", background_.sizes(), " ", background_.scalar_type());
  TORCH_CHECK(background_.device() == picture_.device(), "the picture is on ", picture_.device(),
              " and the background on ", background_.device());
  const at::Tensor picture = picture_.contiguous(), background = background_.contiguous();
  at::Tensor out = at::empty({3, picture.size(1), picture.size(2)}, background.options());
  const gs::Composite args{picture.const_data_ptr<uint8_t>(), background.const_data_ptr<float>(),
                           picture.size(1) * picture.size(2), out.mutable_data_ptr<float>()};
#ifdef GS_CUDA
  if (picture.is_cuda()) {
    gs::TorchQueue queue(picture.device());
    gs::composite_cuda(args, queue.queue());
    return out;
  }
#endif
  gs::composite_cpu(args, gs::torch_executor());
  return out;
}

}  // namespace

TORCH_LIBRARY(fused_ssim, m) {
  m.def("l1_ssim(Tensor img1, Tensor img2, bool valid, bool train) -> (Tensor l1, Tensor ssim, Tensor kept)");
  m.def(
      "l1_ssim_vjp(Tensor img1, Tensor img2, Tensor kept, Tensor grad_l1, Tensor grad_ssim)"
      " -> Tensor grad_img1");
  m.def(
      "photometric(Tensor image, Tensor target, float lambda_dssim, bool train)"
      " -> (Tensor loss, Tensor l1, Tensor kept)");
  m.def(
      "photometric_vjp(Tensor image, Tensor target, Tensor kept, float lambda_dssim, Tensor grad_loss)"
      " -> Tensor grad_image");
  m.def("composite(Tensor picture, Tensor background) -> Tensor");
}

TORCH_LIBRARY_IMPL(fused_ssim, CPU, m) {
  m.impl("l1_ssim", &l1_ssim);
  m.impl("l1_ssim_vjp", &l1_ssim_vjp);
  m.impl("photometric", &photometric);
  m.impl("photometric_vjp", &photometric_vjp);
  m.impl("composite", &composite);
}

#ifdef GS_CUDA
TORCH_LIBRARY_IMPL(fused_ssim, CUDA, m) {
  m.impl("l1_ssim", &l1_ssim_on_cuda);
  m.impl("l1_ssim_vjp", &l1_ssim_vjp_on_cuda);
  m.impl("photometric", &photometric_on_cuda);
  m.impl("photometric_vjp", &photometric_vjp_on_cuda);
  m.impl("composite", &composite);
}
#endif

}  // namespace gs::ops
