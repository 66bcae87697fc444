// The ops that change parameters, gradients and statistics in place: Adam, penalties, and what density control
// observes.
#include "optim.h"

#include <utility>
#include <vector>

#include "math/adam.h"

namespace gs::ops {

void check_moments(const Tensor& value, const Tensor& gradient, const Tensor& exp_avg, const Tensor& exp_avg_sq) {
  for (const auto& [name, t] : {std::pair("value", &value), std::pair("gradient", &gradient),
                                std::pair("exp_avg", &exp_avg), std::pair("exp_avg_sq", &exp_avg_sq)})
    check_given(*t, name);
  for (const Tensor* t : {&gradient, &exp_avg, &exp_avg_sq})
    GS_CHECK(same(t->sizes(), value.sizes()) && alike(*t, value),
             "gradient and averages must have the shape, dtype and device of the parameter, ", in_words(value),
             ", got ", in_words(*t));
  GS_CHECK(value.is_contiguous() && exp_avg.is_contiguous() && exp_avg_sq.is_contiguous(),
           "parameter and averages must be contiguous");
}

void check_counter(const Tensor& step) {
  check_given(step, "step");
  GS_CHECK(step.is_cpu() && step.numel() == 1 && has_dtype(step, ScalarType::Float),
           "a step counter must be one float32 on the CPU, got ", in_words(step));
}

void check_statistics(const Tensor& max_radii, const Tensor& gradient_sums, const Tensor& views, const Tensor& radii,
                      int64_t count) {
  for (const auto& [name, t] :
       {std::pair("max_radii", &max_radii), std::pair("gradient_sums", &gradient_sums), std::pair("views", &views)})
    check_given(*t, name);
  check_given(radii, "radii");
  for (const Tensor* t : {&max_radii, &gradient_sums, &views}) {
    GS_CHECK(t->numel() == count && has_dtype(*t, ScalarType::Float) && t->device() == radii.device(),
             "statistics must be ", count, " float32 on ", radii.device(), ", got ", in_words(*t));
    GS_CHECK(t->is_contiguous(), "statistics must be contiguous");
  }
  GS_CHECK(has_dtype(radii, ScalarType::Int), "radii must be int32, got ", radii.scalar_type());
}

namespace {

void check_visible(const Tensor& visible, const Tensor& value) {
  const int64_t rows = rows_of(value);
  GS_CHECK(visible.dim() == 1 && visible.size(0) == rows && has_dtype(visible, ScalarType::Bool) &&
               visible.device() == value.device(),
           "visible must be (", rows, ") bool on ", value.device(), ", got ", in_words(visible));
}

// Takes one step of every parameter, in one launch on a GPU. Advances each counter first, as torch does, even if
// the guard holds the step back. visible: these rows alone step; without counters it is a step of sparse Adam.
void adam_op(List<Tensor> values, List<Tensor> gradients, List<Tensor> exp_avg, List<Tensor> exp_avg_sq,
             List<Tensor> steps, List<double> rates, double beta1, double beta2, double eps, Sizes columns,
             const MaybeTensor& visible, const MaybeTensor& loss, const MaybeTensor& stopped, int64_t iteration) {
  const size_t n = values.size();
  for (size_t size : {gradients.size(), exp_avg.size(), exp_avg_sq.size(), visible && steps.empty() ? n : steps.size(),
                      rates.size(), columns.size()})
    GS_CHECK(size == n, "every list must have an entry for each of the ", n, " parameters, got ", size);
  if (n == 0) return;
  const Tensor& first = values[0];
  std::vector<Tensor> contiguous;  // keeps the gradients' memory until the call is over
  for (size_t i = 0; i < n; ++i) {
    check_moments(values[i], gradients[i], exp_avg[i], exp_avg_sq[i]);
    GS_CHECK(alike(values[i], first), "all parameters must have one dtype and device");
    if (visible) check_visible(*visible, values[i]);
    contiguous.push_back(packed(gradients[i]));
  }
  for (const Tensor& step : steps) check_counter(step);
  with_scalar(first.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    std::vector<gs::AdamInput<T>> inputs;
    for (size_t i = 0; i < n; ++i) {
      gs::AdamInput<T> in = adam_input<T>(values[i], contiguous[i], exp_avg[i], exp_avg_sq[i], columns[i]);
      in.lr = rates[i], in.beta1 = beta1, in.beta2 = beta2, in.eps = eps;
      if (!steps.empty()) in.step = double(*read<float>(steps[i])) + 1;
      inputs.push_back(in);
    }
    const gs::StepGuard<T> guard = step_guard<T>(first, loss, stopped, iteration);
    if (!visible) {
      GS_RUN(T, first, adam, inputs.data(), int64_t(n), guard);
      return;
    }
    const Tensor mask = packed(*visible);
    for (const gs::AdamInput<T>& in : inputs)
      if (in.rows * in.row) GS_RUN(T, first, sparse_adam, in, read<bool>(mask), guard);
  });
  for (const Tensor& step : steps) *write<float>(step) += 1;
}

void observe_op(Tensor& max_radii, Tensor& gradient_sums, Tensor& views, const Tensor& radii, const Tensor& gradient) {
  check_given(radii, "radii");
  const int64_t n = radii.numel();
  check_statistics(max_radii, gradient_sums, views, radii, n);
  check_given(gradient, "gradient");
  const bool lengths = gradient.dim() == 1;
  GS_CHECK((lengths || (gradient.dim() == 2 && gradient.size(1) == 3)) && gradient.size(0) == n &&
               has_dtype(gradient, ScalarType::Float) && gradient.device() == radii.device(),
           "the gradient must be (", n, ", 3) float32 on ", radii.device(), ", or its lengths (", n, ",), got ",
           in_words(gradient));
  const Tensor pixels = packed(radii), rows = packed(gradient);
  const gs::ObserveInput in{n,
                            write<float>(max_radii),
                            write<float>(gradient_sums),
                            write<float>(views),
                            read<int32_t>(pixels),
                            lengths ? nullptr : read<float>(rows),
                            lengths ? read<float>(rows) : nullptr};
  run_at(radii, [&](const auto& where) { gs::observe(where, in); }, halted());
}

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
      "adam_(Tensor(a!)[] values, Tensor[] gradients, Tensor(b!)[] exp_avg, Tensor(c!)[] exp_avg_sq, "
      "Tensor(d!)[] steps, float[] rates, float beta1, float beta2, float eps, int[] columns, Tensor? visible=None, "
      "Tensor? loss=None, Tensor(e!)? stopped=None, int iteration=0) -> ()",
      TORCH_BOX(&adam_op));
  m.define(
      "observe_(Tensor(a!) max_radii, Tensor(b!) gradient_sums, Tensor(c!) views, Tensor radii, Tensor gradient) "
      "-> ()",
      TORCH_BOX(&observe_op));
  m.define(
      "penalise_(Tensor logits, Tensor log_scales, Tensor(a!) logit_gradients, Tensor(b!) log_scale_gradients, "
      "float opacity, float scale) -> ()",
      TORCH_BOX(&penalise_op));
}

}  // namespace gs::ops
