// The op that adds the gradients of penalties on opacities and scales.
#include "tensors.h"

namespace gs::ops {

namespace {

void penalise_op(const Tensor& logits, const Tensor& log_scales, Tensor& logit_gradients, Tensor& log_scale_gradients,
                 double opacity, double scale) {
  check_given(logits, "logits");
  const int64_t n = logits.dim() > 0 ? logits.size(0) : 0;
  check_precise(logits, "logits", {n, 1});
  const ScalarType type = logits.scalar_type();
  check_tensor(log_scales, "log_scales", type, logits.device(), {n, 3});
  check_tensor(logit_gradients, "logit_gradients", type, logits.device(), {n, 1});
  check_tensor(log_scale_gradients, "log_scale_gradients", type, logits.device(), {n, 3});
  GS_CHECK_VALUE(logit_gradients.is_contiguous() && log_scale_gradients.is_contiguous(),
                 "gradients must be contiguous");
  const Tensor opacities = packed(logits), sizes = packed(log_scales);
  with_scalar(type, [&](auto zero) {
    using T = decltype(zero);
    const gs::PenaltyInput<T> in{n,
                                 {T(opacity), T(scale)},
                                 read<T>(opacities),
                                 read<T>(sizes),
                                 write<T>(logit_gradients),
                                 write<T>(log_scale_gradients)};
    GS_RUN(T, logits, penalise, in);
  });
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "penalise_(Tensor logits, Tensor log_scales, Tensor(a!) logit_gradients, Tensor(b!) log_scale_gradients, "
      "float opacity, float scale) -> ()",
      TORCH_BOX(&penalise_op));
}

}  // namespace gs::ops
