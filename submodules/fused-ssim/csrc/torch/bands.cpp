// The ops of the photometric loss of a band of an image.
#include <ATen/ops/zeros.h>

#include <tuple>

#include "photometric.h"

namespace gs::ops {
namespace {

// Rows [first, end) of an image of which a part is there (RowRange).
gs::RowRange band(const at::Tensor& img1, int64_t first, int64_t end) {
  const int64_t height = img1.size(-2);
  const auto is_border = [&](int64_t row) { return row == height || (row >= 0 && row % gs::kBandRows == 0); };
  TORCH_CHECK_VALUE(is_border(first) && is_border(end) && first <= end && end <= height,
                    "a band begins and ends at multiples of ", gs::kBandRows, " rows or with the image, got ", first,
                    " and ", end, " of ", height);
  return {first, end};
}

// The shape of the sums of all bands of an image.
at::DimVector sums_shape(const at::Tensor& img1) {
  const int64_t height = img1.size(-2), width = img1.size(-1), planes = img1.numel() / (height * width);
#ifdef GS_CUDA
  if (img1.is_cuda()) return {gs::sum_blocks(planes, height, width), 2};
#endif
  const int64_t parts = img1.scalar_type() == at::kFloat ? gs::row_parts<float>(width) : gs::row_parts<double>(width);
  return {planes * height * parts, 2};
}

at::Tensor no_sums(const at::Tensor& img1) { return at::zeros(sums_shape(img1), img1.options().dtype(at::kDouble)); }

void check_sums(const at::Tensor& sums, const at::Tensor& img1) {
  check_given(sums, "sums");
  const at::DimVector wanted = sums_shape(img1);
  TORCH_CHECK(sums.is_contiguous() && sums.scalar_type() == at::kDouble && sums.device() == img1.device() &&
                  sums.sizes() == at::IntArrayRef(wanted),
              "sums must be those of all bands added, ", at::IntArrayRef(wanted), " float64, got ", sums.sizes(), " ",
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

}  // namespace

TORCH_LIBRARY_FRAGMENT(fused_ssim, m) {
  m.def("photometric_band(Tensor image, Tensor target, int first, int end) -> (Tensor sums, Tensor kept)");
  m.def("photometric_of_sums(Tensor image, Tensor sums, float lambda_dssim) -> (Tensor loss, Tensor l1)");
  m.def(
      "photometric_band_vjp(Tensor image, Tensor target, Tensor kept, float lambda_dssim, Tensor grad_loss, int first,"
      " int end) -> Tensor grad_image");
}

TORCH_LIBRARY_IMPL(fused_ssim, CPU, m) {
  m.impl("photometric_band", &photometric_band);
  m.impl("photometric_of_sums", &photometric_of_sums);
  m.impl("photometric_band_vjp", &photometric_band_vjp);
}

#ifdef GS_CUDA
TORCH_LIBRARY_IMPL(fused_ssim, CUDA, m) {
  m.impl("photometric_band", &photometric_band_on_cuda);
  m.impl("photometric_of_sums", &photometric_of_sums_on_cuda);
  m.impl("photometric_band_vjp", &photometric_band_vjp_on_cuda);
}
#endif

}  // namespace gs::ops
