// The ops of the photometric loss, and of compositing: checks, memory and the way to a backend.
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <tuple>

#include "backend.h"
#include "gs/torch_executor.h"

#ifdef GS_CUDA
#include "gs/torch_queue.h"
#endif

namespace {

// TypeError for Python's None, which arrives as an undefined tensor where the schema wants one.
void check_given(const at::Tensor& t, const char* name) {
  TORCH_CHECK_TYPE(t.defined(), name, " must be a tensor, got None");
}

void check_images(const at::Tensor& img1, const at::Tensor& img2, bool valid) {
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
at::DimVector kept_shape(const at::Tensor& img1, const gs::RowRange& rows) {
  if (!img1.is_cuda()) return at::DimVector(img1.sizes());
  const int64_t height = img1.size(-2), width = img1.size(-1);
  const gs::RowRange maps = gs::map_rows(rows, height);
  return {img1.numel() / (height * width), gs::map_strips(width), maps.end - maps.begin, gs::kMapRow};
}

gs::RowRange all_rows(const at::Tensor& img1) { return {0, img1.size(-2)}; }

// Memory for it, if there will be a backward.
at::Tensor empty_kept(const at::Tensor& img1, bool train) {
  return at::empty(train ? kept_shape(img1, all_rows(img1)) : at::DimVector{0}, img1.options());
}

template <class T>
at::Tensor scalar(T value, const at::TensorOptions& options) {
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
Means means_of(const gs::ImagePair<T>& images, bool valid, at::Tensor& gradient) {
  Means means{};
  const gs::L1Ssim<T> args{images, valid, &means.l1, &means.ssim,
                           gradient.numel() ? gradient.mutable_data_ptr<T>() : nullptr};
  GS_DISPATCH(l1_ssim_cpu, args, gs::torch_executor());
  return means;
}

template <class T>
T photometric_loss(const Means& means, double lambda) {
  return T(1 - lambda) * T(means.l1) + T(lambda) * (1 - T(means.ssim));
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

void check_kept(const at::Tensor& kept, const at::Tensor& img1, const gs::RowRange& rows) {
  check_given(kept, "kept");
  const at::DimVector wanted = kept_shape(img1, rows);
  TORCH_CHECK(kept.sizes() == at::IntArrayRef(wanted) && kept.scalar_type() == img1.scalar_type(), "kept must be ",
              at::IntArrayRef(wanted), " of ", img1.scalar_type(), ", as a forward with train = True gives it, got ",
              kept.sizes(), " of ", kept.scalar_type());
}

// Checks the gradient of a mean.
void check_scalar(const at::Tensor& grad, const at::Tensor& img1) {
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

at::Tensor photometric_rows_vjp(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept, double lambda,
                                const at::Tensor& grad_loss, const gs::RowRange* rows) {
  check_images(img1, img2, false);
  check_kept(kept, img1, rows ? *rows : all_rows(img1));
  check_scalar(grad_loss, img1);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const T grad = grad_loss.item<T>();
    return vjp<T>(img1, img2, kept, true, grad * T(1 - lambda), grad * -T(lambda), rows);
  });
}

at::Tensor photometric_vjp(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept, double lambda,
                           const at::Tensor& grad_loss) {
  return photometric_rows_vjp(img1, img2, kept, lambda, grad_loss, nullptr);
}

// Rows [first, end) of an image of which a part is there (RowRange).
gs::RowRange band(const at::Tensor& img1, int64_t first, int64_t end) {
  const int64_t height = img1.size(-2);
  const auto is_border = [&](int64_t row) { return row == height || (row >= 0 && row % gs::kBandRows == 0); };
  TORCH_CHECK_VALUE(is_border(first) && is_border(end) && first <= end && end <= height,
                    "a band begins and ends at multiples of ", gs::kBandRows, " rows or with the image, got ", first,
                    " and ", end, " of ", height);
  return {first, end};
}

// Zeros for the sums of all bands of an image.
at::Tensor no_sums(const at::Tensor& img1) {
  const int64_t height = img1.size(-2), width = img1.size(-1), planes = img1.numel() / (height * width);
  const auto options = img1.options().dtype(at::kDouble);
#ifdef GS_CUDA
  if (img1.is_cuda()) return at::zeros({gs::sum_blocks(planes, height, width), 2}, options);
#endif
  const int64_t parts = img1.scalar_type() == at::kFloat ? gs::row_parts<float>(width) : gs::row_parts<double>(width);
  return at::zeros({planes * height * parts, 2}, options);
}

void check_sums(const at::Tensor& sums, const at::Tensor& img1) {
  check_given(sums, "sums");
  TORCH_CHECK(sums.is_contiguous() && sums.scalar_type() == at::kDouble && sums.device() == img1.device() &&
                  sums.sizes() == no_sums(img1).sizes(),
              "sums must be those of all bands added, ", no_sums(img1).sizes(), " float64, got ", sums.sizes(), " ",
              sums.scalar_type());
}

// The sums of a band, and what its backward needs.
std::tuple<at::Tensor, at::Tensor> photometric_band(const at::Tensor& img1_, const at::Tensor& img2_, int64_t first,
                                                    int64_t end) {
  check_images(img1_, img2_, false);
  const gs::RowRange rows = band(img1_, first, end);
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  at::Tensor kept = at::empty(kept_shape(img1, rows), img1.options()), sums = no_sums(img1);
  with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const gs::L1Ssim<T> args{
        image_pair<T>(img1, img2, true), false, nullptr, nullptr, kept.mutable_data_ptr<T>(), &rows,
        sums.mutable_data_ptr<double>()};
    GS_DISPATCH(l1_ssim_cpu, args, gs::torch_executor());
  });
  return {sums, kept};
}

// What `photometric` gives first, from the sums of all bands.
std::tuple<at::Tensor, at::Tensor> photometric_of_sums(const at::Tensor& img1, const at::Tensor& sums, double lambda) {
  check_images(img1, img1, false);
  check_sums(sums, img1);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    Means means{};
    const gs::L1SsimMeans<T> args{image_pair<T>(img1, img1, true), sums.const_data_ptr<double>(), &means.l1,
                                  &means.ssim};
    GS_DISPATCH(l1_ssim_means_cpu, args);
    return std::tuple(scalar(photometric_loss<T>(means, lambda), img1.options()), scalar(T(means.l1), img1.options()));
  });
}

// The gradient of the image in the rows of a band; it has any values in the others.
at::Tensor photometric_band_vjp(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept, double lambda,
                                const at::Tensor& grad_loss, int64_t first, int64_t end) {
  check_images(img1, img2, false);
  const gs::RowRange rows = band(img1, first, end);
  return photometric_rows_vjp(img1, img2, kept, lambda, grad_loss, &rows);
}

#ifdef GS_CUDA
void check_images_cuda(const at::Tensor& img1, const at::Tensor& img2, bool valid) {
  check_images(img1, img2, valid);
  TORCH_CHECK(img1.scalar_type() == at::kFloat, "img1 must be float32 on a GPU, got ", img1.scalar_type());
  TORCH_CHECK(img1.device() == img2.device(), "img1 is on ", img1.device(), " and img2 on ", img2.device());
}

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

void check_on_cuda(const at::Tensor& gradient, const at::Tensor& img1) {
  TORCH_CHECK(gradient.device() == img1.device() && gradient.scalar_type() == at::kFloat,
              "the gradients must be float32 on ", img1.device(), " like img1, got ", gradient.scalar_type(), " on ",
              gradient.device());
}

at::Tensor vjp_on_cuda(const at::Tensor& img1_, const at::Tensor& img2_, const at::Tensor& kept_, bool clamp,
                       const at::Tensor& grad_l1, float l1_weight, const at::Tensor& grad_ssim, float ssim_weight,
                       const gs::RowRange* rows = nullptr) {
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

at::Tensor l1_ssim_vjp_on_cuda(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept,
                               const at::Tensor& grad_l1, const at::Tensor& grad_ssim) {
  return vjp_on_cuda(img1, img2, kept, false, grad_l1, 1, grad_ssim, 1);
}

at::Tensor photometric_vjp_on_cuda(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept,
                                   double lambda, const at::Tensor& grad_loss) {
  return vjp_on_cuda(img1, img2, kept, true, grad_loss, float(1 - lambda), grad_loss, -float(lambda));
}

std::tuple<at::Tensor, at::Tensor> photometric_band_on_cuda(const at::Tensor& img1_, const at::Tensor& img2_,
                                                            int64_t first, int64_t end) {
  check_images_cuda(img1_, img2_, false);
  const gs::RowRange rows = band(img1_, first, end);
  gs::TorchQueue queue(img1_.device());
  const at::Tensor img1 = img1_.contiguous(), img2 = img2_.contiguous();
  at::Tensor kept = at::empty(kept_shape(img1, rows), img1.options()), sums = no_sums(img1);
  gs::L1SsimCuda args{image_pair<float>(img1, img2, true), false, nullptr, nullptr, kept.mutable_data_ptr<float>()};
  args.rows = &rows, args.sums = sums.mutable_data_ptr<double>();
  gs::l1_ssim_cuda(args, queue.queue());
  return {sums, kept};
}

std::tuple<at::Tensor, at::Tensor> photometric_of_sums_on_cuda(const at::Tensor& img1, const at::Tensor& sums,
                                                               double lambda) {
  check_images_cuda(img1, img1, false);
  check_sums(sums, img1);
  gs::TorchQueue queue(img1.device());
  at::Tensor loss = at::empty({}, img1.options()), l1 = at::empty({}, img1.options());
  gs::L1SsimCuda args{image_pair<float>(img1, img1, true),
                      false,
                      l1.mutable_data_ptr<float>(),
                      nullptr,
                      nullptr,
                      loss.mutable_data_ptr<float>(),
                      float(1 - lambda),
                      float(lambda)};
  args.sums = const_cast<double*>(sums.const_data_ptr<double>());
  gs::l1_ssim_means_cuda(args, queue.queue());
  return {loss, l1};
}

at::Tensor photometric_band_vjp_on_cuda(const at::Tensor& img1, const at::Tensor& img2, const at::Tensor& kept,
                                        double lambda, const at::Tensor& grad_loss, int64_t first, int64_t end) {
  check_images_cuda(img1, img2, false);
  const gs::RowRange rows = band(img1, first, end);
  return vjp_on_cuda(img1, img2, kept, true, grad_loss, float(1 - lambda), grad_loss, -float(lambda), &rows);
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
  m.def("photometric_band(Tensor image, Tensor target, int first, int end) -> (Tensor sums, Tensor kept)");
  m.def("photometric_of_sums(Tensor image, Tensor sums, float lambda_dssim) -> (Tensor loss, Tensor l1)");
  m.def(
      "photometric_band_vjp(Tensor image, Tensor target, Tensor kept, float lambda_dssim, Tensor grad_loss, int first,"
      " int end) -> Tensor grad_image");
  m.def("composite(Tensor picture, Tensor background) -> Tensor");
}

TORCH_LIBRARY_IMPL(fused_ssim, CPU, m) {
  m.impl("l1_ssim", &l1_ssim);
  m.impl("l1_ssim_vjp", &l1_ssim_vjp);
  m.impl("photometric", &photometric);
  m.impl("photometric_vjp", &photometric_vjp);
  m.impl("photometric_band", &photometric_band);
  m.impl("photometric_of_sums", &photometric_of_sums);
  m.impl("photometric_band_vjp", &photometric_band_vjp);
  m.impl("composite", &composite);
}

#ifdef GS_CUDA
TORCH_LIBRARY_IMPL(fused_ssim, CUDA, m) {
  m.impl("l1_ssim", &l1_ssim_on_cuda);
  m.impl("l1_ssim_vjp", &l1_ssim_vjp_on_cuda);
  m.impl("photometric", &photometric_on_cuda);
  m.impl("photometric_vjp", &photometric_vjp_on_cuda);
  m.impl("photometric_band", &photometric_band_on_cuda);
  m.impl("photometric_of_sums", &photometric_of_sums_on_cuda);
  m.impl("photometric_band_vjp", &photometric_band_vjp_on_cuda);
  m.impl("composite", &composite);
}
#endif
