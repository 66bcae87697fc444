// The ops of the photometric loss of a band of an image.
#include <tuple>

#include "photometric.h"

namespace gs::ops {
namespace {

// Rows [first, end) of an image of which a part is there (RowRange).
gs::RowRange band(const Tensor& img1, int64_t first, int64_t end) {
  const int64_t height = img1.size(-2);
  const auto is_border = [&](int64_t row) { return row == height || (row >= 0 && row % gs::kBandRows == 0); };
  GS_CHECK_VALUE(is_border(first) && is_border(end) && first <= end && end <= height,
                 "a band begins and ends at multiples of ", gs::kBandRows, " rows or with the image, got ", first,
                 " and ", end, " of ", height);
  return {first, end};
}

// The shape of the sums of all bands of an image.
Shape sums_shape(const Tensor& img1) {
  const int64_t height = img1.size(-2), width = img1.size(-1), planes = img1.numel() / (height * width);
#ifdef GS_CUDA
  if (img1.is_cuda()) return {gs::sum_blocks(planes, height, width), 2};
#endif
  const int64_t parts =
      img1.scalar_type() == ScalarType::Float ? gs::row_parts<float>(width) : gs::row_parts<double>(width);
  return {planes * height * parts, 2};
}

Tensor no_sums(const Tensor& img1) { return torch::stable::new_zeros(img1, sums_shape(img1), ScalarType::Double); }

void check_sums(const Tensor& sums, const Tensor& img1) {
  check_given(sums, "sums");
  const Shape wanted = sums_shape(img1);
  GS_CHECK(sums.is_contiguous() && sums.scalar_type() == ScalarType::Double && sums.device() == img1.device() &&
               same(sums.sizes(), wanted),
           "sums must be those of all bands added, ", wanted, " float64, got ", sums.sizes(), " ", sums.scalar_type());
}

// The sums of a band, and what its backward needs.
std::tuple<Tensor, Tensor> photometric_band(const Tensor& img1_, const Tensor& img2_, int64_t first, int64_t end,
                                            bool clamp) {
  check_images(img1_, img2_, false);
  const gs::RowRange rows = band(img1_, first, end);
  const Tensor img1 = packed(img1_), img2 = packed(img2_);
  Tensor kept = empty(kept_shape(img1, rows), img1), sums = no_sums(img1);
  with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const gs::L1Ssim<T> args{
        image_pair<T>(img1, img2, clamp), false, nullptr, nullptr, write<T>(kept), &rows, write<double>(sums)};
    GS_DISPATCH(l1_ssim_cpu, args, gs::torch_executor());
  });
  return {sums, kept};
}

// What `photometric` gives first, from the sums of all bands.
std::tuple<Tensor, Tensor> photometric_of_sums(const Tensor& img1, const Tensor& sums, double lambda) {
  check_images(img1, img1, false);
  check_sums(sums, img1);
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    Means means{};
    const gs::L1SsimMeans<T> args{image_pair<T>(img1, img1, false), read<double>(sums), &means.l1, &means.ssim};
    GS_DISPATCH(l1_ssim_means_cpu, args);
    return std::tuple(scalar(photometric_loss<T>(means, lambda), img1), scalar(T(means.l1), img1));
  });
}

// The gradient of the image in the rows of a band; it has any values in the others.
Tensor photometric_band_vjp(const Tensor& img1, const Tensor& img2, const Tensor& kept, double lambda,
                            const Tensor& grad_loss, int64_t first, int64_t end, bool clamp) {
  check_images(img1, img2, false);
  const gs::RowRange rows = band(img1, first, end);
  return photometric_rows_vjp(img1, img2, kept, clamp, lambda, grad_loss, &rows);
}

#ifdef GS_CUDA
std::tuple<Tensor, Tensor> photometric_band_on_cuda(const Tensor& img1_, const Tensor& img2_, int64_t first,
                                                    int64_t end, bool clamp) {
  check_images_cuda(img1_, img2_, false);
  const gs::RowRange rows = band(img1_, first, end);
  gs::TorchQueue queue(img1_.device());
  const Tensor img1 = packed(img1_), img2 = packed(img2_);
  Tensor kept = empty(kept_shape(img1, rows), img1), sums = no_sums(img1);
  gs::L1SsimCuda args{image_pair<float>(img1, img2, clamp), false, nullptr, nullptr, write<float>(kept)};
  args.rows = &rows, args.sums = write<double>(sums);
  gs::l1_ssim_cuda(args, queue.queue());
  return {sums, kept};
}

std::tuple<Tensor, Tensor> photometric_of_sums_on_cuda(const Tensor& img1, const Tensor& sums, double lambda) {
  check_images_cuda(img1, img1, false);
  check_sums(sums, img1);
  gs::TorchQueue queue(img1.device());
  Tensor loss = empty({}, img1), l1 = empty({}, img1);
  gs::L1SsimCuda args{image_pair<float>(img1, img1, false),
                      false,
                      write<float>(l1),
                      nullptr,
                      nullptr,
                      write<float>(loss),
                      float(1 - lambda),
                      float(lambda)};
  args.sums = const_cast<double*>(read<double>(sums));
  gs::l1_ssim_means_cuda(args, queue.queue());
  return {loss, l1};
}

Tensor photometric_band_vjp_on_cuda(const Tensor& img1, const Tensor& img2, const Tensor& kept, double lambda,
                                    const Tensor& grad_loss, int64_t first, int64_t end, bool clamp) {
  check_images_cuda(img1, img2, false);
  const gs::RowRange rows = band(img1, first, end);
  return vjp_on_cuda(img1, img2, kept, clamp, grad_loss, float(1 - lambda), grad_loss, -float(lambda), &rows);
}
#endif

}  // namespace

GS_OPERATORS(fused_ssim, m) {
  m.define(
      "photometric_band(Tensor image, Tensor target, int first, int end, bool clamp=True) -> (Tensor sums, Tensor "
      "kept)",
      GS_BOTH(photometric_band));
  m.define("photometric_of_sums(Tensor image, Tensor sums, float lambda_dssim) -> (Tensor loss, Tensor l1)",
           GS_BOTH(photometric_of_sums));
  m.define(
      "photometric_band_vjp(Tensor image, Tensor target, Tensor kept, float lambda_dssim, Tensor grad_loss, int first,"
      " int end, bool clamp=True) -> Tensor grad_image",
      GS_BOTH(photometric_band_vjp));
}

}  // namespace gs::ops
