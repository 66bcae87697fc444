// The ops of the photometric loss, and of compositing: checks, memory and the way to a backend.
#include <tuple>

#include "photometric.h"

namespace gs::ops {
namespace {

template <class T>
Means means_of(const gs::ImagePair<T>& images, bool valid, Tensor& gradient) {
  Means means{};
  const gs::L1Ssim<T> args{images, valid, &means.l1, &means.ssim, gradient.numel() ? write<T>(gradient) : nullptr};
  GS_DISPATCH(l1_ssim_cpu, args, gs::torch_executor());
  return means;
}

using Tensors3 = std::tuple<Tensor, Tensor, Tensor>;

Tensors3 l1_ssim(const Tensor& img1_, const Tensor& img2_, bool valid, bool train) {
  check_images(img1_, img2_, valid);
  const Tensor img1 = packed(img1_), img2 = packed(img2_);
  Tensor gradient = empty_kept(img1, train);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const Means means = means_of(image_pair<T>(img1, img2, false), valid, gradient);
    return Tensors3(scalar(T(means.l1), img1), scalar(T(means.ssim), img1), gradient);
  });
}

Tensors3 photometric(const Tensor& img1_, const Tensor& img2_, double lambda, bool train, bool clamp) {
  check_images(img1_, img2_, false);
  const Tensor img1 = packed(img1_), img2 = packed(img2_);
  Tensor gradient = empty_kept(img1, train);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const Means means = means_of(image_pair<T>(img1, img2, clamp), false, gradient);
    return Tensors3(scalar(photometric_loss<T>(means, lambda), img1), scalar(T(means.l1), img1), gradient);
  });
}

Tensor l1_ssim_vjp(const Tensor& img1, const Tensor& img2, const Tensor& kept, const Tensor& grad_l1,
                   const Tensor& grad_ssim) {
  check_images(img1, img2, false);
  check_kept(kept, img1, all_rows(img1));
  check_scalar(grad_l1, img1), check_scalar(grad_ssim, img1);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    return vjp<T>(img1, img2, kept, false, value_of<T>(grad_l1), value_of<T>(grad_ssim));
  });
}

Tensor photometric_vjp(const Tensor& img1, const Tensor& img2, const Tensor& kept, double lambda,
                       const Tensor& grad_loss, bool clamp) {
  return photometric_rows_vjp(img1, img2, kept, clamp, lambda, grad_loss, nullptr);
}

#ifdef GS_CUDA
Tensors3 l1_ssim_on_cuda(const Tensor& img1_, const Tensor& img2_, bool valid, bool train) {
  check_images_cuda(img1_, img2_, valid);
  gs::TorchQueue queue(img1_.device());
  const Tensor img1 = packed(img1_), img2 = packed(img2_);
  Tensor l1 = empty({}, img1), ssim = empty({}, img1);
  Tensor kept = empty_kept(img1, train);
  gs::l1_ssim_cuda({image_pair<float>(img1, img2, false), valid, write<float>(l1), write<float>(ssim),
                    train ? write<float>(kept) : nullptr},
                   queue.queue());
  return {l1, ssim, kept};
}

Tensors3 photometric_on_cuda(const Tensor& img1_, const Tensor& img2_, double lambda, bool train, bool clamp) {
  check_images_cuda(img1_, img2_, false);
  gs::TorchQueue queue(img1_.device());
  const Tensor img1 = packed(img1_), img2 = packed(img2_);
  Tensor loss = empty({}, img1), l1 = empty({}, img1);
  Tensor kept = empty_kept(img1, train);
  gs::l1_ssim_cuda({image_pair<float>(img1, img2, clamp), false, write<float>(l1), nullptr,
                    train ? write<float>(kept) : nullptr, write<float>(loss), float(1 - lambda), float(lambda)},
                   queue.queue());
  return {loss, l1, kept};
}

Tensor l1_ssim_vjp_on_cuda(const Tensor& img1, const Tensor& img2, const Tensor& kept, const Tensor& grad_l1,
                           const Tensor& grad_ssim) {
  return vjp_on_cuda(img1, img2, kept, false, grad_l1, 1, grad_ssim, 1);
}

Tensor photometric_vjp_on_cuda(const Tensor& img1, const Tensor& img2, const Tensor& kept, double lambda,
                               const Tensor& grad_loss, bool clamp) {
  return vjp_on_cuda(img1, img2, kept, clamp, grad_loss, float(1 - lambda), grad_loss, -float(lambda));
}

#endif

Tensor composite(const Tensor& picture_, const Tensor& background_) {
  check_given(picture_, "the picture"), check_given(background_, "the background");
  GS_CHECK(picture_.dim() == 3 && picture_.size(0) == 4 && picture_.scalar_type() == ScalarType::Byte,
           "the picture must be (4, H, W) uint8, got ", picture_.sizes(), " ", picture_.scalar_type());
  GS_CHECK(background_.numel() == 3 && background_.scalar_type() == ScalarType::Float,
           "the background must be 3 float32, got ", background_.sizes(), " ", background_.scalar_type());
  GS_CHECK(background_.device() == picture_.device(), "the picture is on ", picture_.device(),
           " and the background on ", background_.device());
  const Tensor picture = packed(picture_), background = packed(background_);
  Tensor out = empty({3, picture.size(1), picture.size(2)}, background);
  const gs::Composite args{read<uint8_t>(picture), read<float>(background), picture.size(1) * picture.size(2),
                           write<float>(out)};
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

GS_OPERATORS(fused_ssim, m) {
  m.define("l1_ssim(Tensor img1, Tensor img2, bool valid, bool train) -> (Tensor l1, Tensor ssim, Tensor kept)",
           GS_BOTH(l1_ssim));
  m.define("l1_ssim_vjp(Tensor img1, Tensor img2, Tensor kept, Tensor grad_l1, Tensor grad_ssim) -> Tensor grad_img1",
           GS_BOTH(l1_ssim_vjp));
  m.define(
      "photometric(Tensor image, Tensor target, float lambda_dssim, bool train, bool clamp=True)"
      " -> (Tensor loss, Tensor l1, Tensor kept)",
      GS_BOTH(photometric));
  m.define(
      "photometric_vjp(Tensor image, Tensor target, Tensor kept, float lambda_dssim, Tensor grad_loss, bool clamp=True)"
      " -> Tensor grad_image",
      GS_BOTH(photometric_vjp));
  m.define("composite(Tensor picture, Tensor background) -> Tensor", TORCH_BOX(&composite));
}

}  // namespace gs::ops
