// The ops of SSIM and the photometric loss, of whole images or of a band of their rows, and of compositing: checks,
// memory and the way to a backend.
#include <tuple>

#include "backend.h"
#include "gs/torch_executor.h"
#include "gs/torch_operators.h"
#include "gs/torch_tensor.h"

namespace gs::ops {
namespace {

using Tensors2 = std::tuple<Tensor, Tensor>;
using Tensors3 = std::tuple<Tensor, Tensor, Tensor>;

void check_images(const Tensor& img1, const Tensor& img2, bool valid) {
  check_given(img1, "img1"), check_given(img2, "img2");
  GS_CHECK(is_floating(img1.scalar_type()), "img1 must be float32 or float64, got ", img1.scalar_type());
  GS_CHECK(img2.scalar_type() == img1.scalar_type() || img2.scalar_type() == ScalarType::Byte, "img2 must be ",
           img1.scalar_type(), " like img1, or uint8, got ", img2.scalar_type());
  GS_CHECK(img1.dim() >= 2 && img1.numel() > 0 && same(img1.sizes(), img2.sizes()),
           "img1 and img2 must be images of the same shape (..., H, W), got ", img1.sizes(), " and ", img2.sizes());
  GS_CHECK(!valid || (img1.size(-1) >= 11 && img1.size(-2) >= 11), "valid needs 11 x 11 pixels or more, got ",
           img1.sizes());
  GS_CHECK(img1.is_cpu() || img1.scalar_type() == ScalarType::Float, "img1 must be float32 on a GPU, got ",
           img1.scalar_type());
  GS_CHECK(img1.device() == img2.device(), "img1 is on ", img1.device(), " and img2 on ", img2.device());
}

// Rows [first, end) of an image of which a part is there (RowRange).
gs::RowRange band(const Tensor& img1, int64_t first, int64_t end) {
  const int64_t height = img1.size(-2);
  const auto is_border = [&](int64_t row) { return row == height || (row >= 0 && row % gs::kBandRows == 0); };
  GS_CHECK_VALUE(is_border(first) && is_border(end) && first <= end && end <= height,
                 "a band begins and ends at multiples of ", gs::kBandRows, " rows or with the image, got ", first,
                 " and ", end, " of ", height);
  return {first, end};
}

// The dimensions of an image: planes, height and width.
struct Size {
  explicit Size(const Tensor& img1)
      : height(img1.size(-2)), width(img1.size(-1)), planes(img1.numel() / (height * width)) {}
  int64_t height, width, planes;
};

template <class T>
gs::ImagePair<T> image_pair(const Tensor& img1, const Tensor& img2, bool clamp) {
  const Size size(img1);
  const bool bytes = img2.scalar_type() == ScalarType::Byte;
  return {read<T>(img1), img2.const_data_ptr(), bytes, size.planes, size.height, size.width, clamp};
}

// The shape of what a forward of some rows keeps for the backward: on the CPU the gradient of SSIM, on a GPU
// L1SsimCuda::maps.
Shape kept_shape(const Tensor& img1, const gs::RowRange& rows) {
  if (!img1.is_cuda()) return img1.sizes().vec();
  const Size size(img1);
  const gs::RowRange maps = gs::map_rows(rows, size.height);
  return {size.planes, gs::map_strips(size.width), maps.end - maps.begin, gs::kMapRow};
}

gs::RowRange all_rows(const Tensor& img1) { return {0, img1.size(-2)}; }

// Memory for it, if there will be a backward.
Tensor empty_kept(const Tensor& img1, bool train) {
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

// What a forward gives of the means: L1 and SSIM, or with `lambda` the loss and L1.
template <class T>
Tensors2 scalars_of(const Means& means, const double* lambda, const Tensor& like) {
  const T l1 = T(means.l1), ssim = T(means.ssim);
  if (!lambda) return {scalar(l1, like), scalar(ssim, like)};
  return {scalar(T(1 - *lambda) * l1 + T(*lambda) * (1 - ssim), like), scalar(l1, like)};
}

#ifdef GS_CUDA
// The same from kernels, which `run` launches with these arguments.
template <class Run>
Tensors2 scalars_of(gs::L1SsimCuda args, const double* lambda, const Tensor& like, const Run& run) {
  const Tensor first = empty({}, like), second = empty({}, like);
  args.l1 = write<float>(lambda ? second : first);
  (lambda ? args.loss : args.ssim) = write<float>(lambda ? first : second);
  if (lambda) args.l1_weight = float(1 - *lambda), args.dssim_weight = float(*lambda);
  gs::TorchQueue queue(like.device());
  run(args, queue.queue());
  return {first, second};
}
#endif

Tensors3 forward(const Tensor& img1_, const Tensor& img2_, bool valid, bool train, bool clamp, const double* lambda) {
  check_images(img1_, img2_, valid);
  const Tensor img1 = packed(img1_), img2 = packed(img2_), kept = empty_kept(img1, train);
#ifdef GS_CUDA
  if (img1.is_cuda()) {
    const gs::L1SsimCuda args{image_pair<float>(img1, img2, clamp), valid, nullptr, nullptr,
                              train ? write<float>(kept) : nullptr};
    return std::tuple_cat(scalars_of(args, lambda, img1, gs::l1_ssim_cuda), std::tuple(kept));
  }
#endif
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    Means means{};
    const gs::L1Ssim<T> args{image_pair<T>(img1, img2, clamp), valid, &means.l1, &means.ssim,
                             kept.numel() ? write<T>(kept) : nullptr};
    GS_DISPATCH(l1_ssim_cpu, args, gs::torch_executor());
    return std::tuple_cat(scalars_of<T>(means, lambda, img1), std::tuple(kept));
  });
}

Tensors3 l1_ssim(const Tensor& img1, const Tensor& img2, bool valid, bool train) {
  return forward(img1, img2, valid, train, false, nullptr);
}

Tensors3 photometric(const Tensor& img1, const Tensor& img2, double lambda, bool train, bool clamp) {
  return forward(img1, img2, false, train, clamp, &lambda);
}

// The shape of the sums of all bands of an image.
Shape sums_shape(const Tensor& img1) {
  const Size size(img1);
#ifdef GS_CUDA
  if (img1.is_cuda()) return {gs::sum_blocks(size.planes, size.height, size.width), 2};
#endif
  const int64_t parts = with_scalar(img1, [&](auto zero) { return gs::row_parts<decltype(zero)>(size.width); });
  return {size.planes * size.height * parts, 2};
}

// The sums of a band, 0 in the places of others, and what its backward needs.
Tensors2 photometric_band(const Tensor& img1_, const Tensor& img2_, int64_t first, int64_t end, bool clamp) {
  check_images(img1_, img2_, false);
  const gs::RowRange rows = band(img1_, first, end);
  const Tensor img1 = packed(img1_), img2 = packed(img2_), kept = empty(kept_shape(img1, rows), img1);
  const Tensor sums = torch::stable::new_zeros(img1, sums_shape(img1), ScalarType::Double);
#ifdef GS_CUDA
  if (img1.is_cuda()) {
    gs::TorchQueue queue(img1.device());
    gs::L1SsimCuda args{image_pair<float>(img1, img2, clamp), false, nullptr, nullptr, write<float>(kept)};
    args.rows = &rows, args.sums = write<double>(sums);
    gs::l1_ssim_cuda(args, queue.queue());
    return {sums, kept};
  }
#endif
  with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const gs::L1Ssim<T> args{
        image_pair<T>(img1, img2, clamp), false, nullptr, nullptr, write<T>(kept), &rows, write<double>(sums)};
    GS_DISPATCH(l1_ssim_cpu, args, gs::torch_executor());
  });
  return {sums, kept};
}

// What `photometric` gives first, from the sums of all bands.
Tensors2 photometric_of_sums(const Tensor& img1, const Tensor& sums, double lambda) {
  check_images(img1, img1, false), check_given(sums, "sums");
  const Shape wanted = sums_shape(img1);
  GS_CHECK(sums.is_contiguous() && sums.scalar_type() == ScalarType::Double && sums.device() == img1.device() &&
               same(sums.sizes(), wanted),
           "sums must be those of all bands added, ", wanted, " float64, got ", sums.sizes(), " ", sums.scalar_type());
#ifdef GS_CUDA
  if (img1.is_cuda()) {
    gs::L1SsimCuda args{image_pair<float>(img1, img1, false), false, nullptr, nullptr, nullptr};
    args.sums = const_cast<double*>(read<double>(sums));
    return scalars_of(args, &lambda, img1, gs::l1_ssim_means_cuda);
  }
#endif
  return with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    Means means{};
    const gs::L1SsimMeans<T> args{image_pair<T>(img1, img1, false), read<double>(sums), &means.l1, &means.ssim};
    GS_DISPATCH(l1_ssim_means_cpu, args);
    return scalars_of<T>(means, &lambda, img1);
  });
}

// What a backward takes: the images and what the forward has kept of some rows.
struct Backward {
  const Tensor &img1, &img2, &kept;
  bool clamp;
  const gs::RowRange* rows;  // null for all
};

// Checks what a backward takes, with the gradient of a mean.
void check_backward(const Backward& in, const Tensor& grad) {
  const Tensor &img1 = in.img1, &kept = in.kept;
  check_images(img1, in.img2, false), check_given(kept, "kept"), check_given(grad, "the gradient of a mean");
  const Shape wanted = kept_shape(img1, in.rows ? *in.rows : all_rows(img1));
  GS_CHECK(same(kept.sizes(), wanted) && kept.scalar_type() == img1.scalar_type(), "kept must be ", wanted, " of ",
           img1.scalar_type(), ", as a forward with train = True gives it, got ", kept.sizes(), " of ",
           kept.scalar_type());
  GS_CHECK_TYPE(grad.scalar_type() == img1.scalar_type(), "the gradient of a mean must be ", img1.scalar_type(),
                " like img1, got ", grad.scalar_type());
  GS_CHECK_VALUE(grad.numel() == 1, "the gradient of a mean must be a scalar, got ", grad.sizes());
  for (const Tensor* t : {&kept, &grad})
    GS_CHECK(img1.is_cpu() || t->device() == img1.device(), "the gradients must be on ", img1.device(),
             " like img1, got one on ", t->device());
}

// The gradient of img1: that of its L1 and of its SSIM, each times a weight.
Tensor vjp(const Backward& in, const Tensor& grad_l1, double l1_weight, const Tensor& grad_ssim, double ssim_weight) {
  check_backward(in, grad_l1), check_backward(in, grad_ssim);
  const Tensor img1 = packed(in.img1), img2 = packed(in.img2), kept = aligned(in.kept, 4);
  Tensor grad_img1 = empty(img1.sizes(), img1);
#ifdef GS_CUDA
  if (img1.is_cuda()) {
    gs::TorchQueue queue(img1.device());
    gs::l1_ssim_vjp_cuda(
        {image_pair<float>(img1, img2, in.clamp), read<float>(kept), read<float>(grad_l1), read<float>(grad_ssim),
         write<float>(grad_img1), float(l1_weight), float(ssim_weight), in.rows},
        queue.queue());
    return grad_img1;
  }
#endif
  with_scalar(img1, [&](auto zero) {
    using T = decltype(zero);
    const T of_l1 = value_of<T>(grad_l1) * T(l1_weight), of_ssim = value_of<T>(grad_ssim) * T(ssim_weight);
    const gs::L1SsimVjp<T> args{image_pair<T>(img1, img2, in.clamp),
                                read<T>(kept),
                                double(of_l1),
                                double(of_ssim),
                                write<T>(grad_img1),
                                in.rows};
    GS_DISPATCH(l1_ssim_vjp_cpu, args, gs::torch_executor());
  });
  return grad_img1;
}

Tensor l1_ssim_vjp(const Tensor& img1, const Tensor& img2, const Tensor& kept, const Tensor& grad_l1,
                   const Tensor& grad_ssim) {
  return vjp({img1, img2, kept, false, nullptr}, grad_l1, 1, grad_ssim, 1);
}

// rows: first and end of a band, whose gradient is right in these alone; or nothing for the whole image.
Tensor photometric_vjp(const Tensor& img1, const Tensor& img2, const Tensor& kept, double lambda,
                       const Tensor& grad_loss, bool clamp, Sizes rows) {
  check_images(img1, img2, false);
  GS_CHECK_VALUE(rows.empty() || rows.size() == 2, "rows must be first and end, got ", rows);
  const gs::RowRange of = rows.empty() ? all_rows(img1) : band(img1, rows[0], rows[1]);
  return vjp({img1, img2, kept, clamp, rows.empty() ? nullptr : &of}, grad_loss, 1 - lambda, grad_loss, -lambda);
}

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
  run_at(picture, [&](const auto& where) { gs::composite(args, where); });
  return out;
}

}  // namespace

GS_OPERATORS(fused_ssim, m) {
  m.define("l1_ssim(Tensor img1, Tensor img2, bool valid, bool train) -> (Tensor l1, Tensor ssim, Tensor kept)",
           TORCH_BOX(&l1_ssim));
  m.define("l1_ssim_vjp(Tensor img1, Tensor img2, Tensor kept, Tensor grad_l1, Tensor grad_ssim) -> Tensor grad_img1",
           TORCH_BOX(&l1_ssim_vjp));
  m.define(
      "photometric(Tensor image, Tensor target, float lambda_dssim, bool train, bool clamp=True)"
      " -> (Tensor loss, Tensor l1, Tensor kept)",
      TORCH_BOX(&photometric));
  m.define(
      "photometric_vjp(Tensor image, Tensor target, Tensor kept, float lambda_dssim, Tensor grad_loss, bool clamp=True,"
      " int[] rows=[]) -> Tensor grad_image",
      TORCH_BOX(&photometric_vjp));
  m.define(
      "photometric_band(Tensor image, Tensor target, int first, int end, bool clamp=True) -> (Tensor sums, Tensor "
      "kept)",
      TORCH_BOX(&photometric_band));
  m.define("photometric_of_sums(Tensor image, Tensor sums, float lambda_dssim) -> (Tensor loss, Tensor l1)",
           TORCH_BOX(&photometric_of_sums));
  m.define("composite(Tensor picture, Tensor background) -> Tensor", TORCH_BOX(&composite));
}

}  // namespace gs::ops
