#pragma once
// Checks of what changes in place: parameters with Adam's averages and counters, a guard, statistics.
#include "tensors.h"

namespace gs::ops {

// Every tensor is given and fits the parameter; parameter and averages are contiguous.
void check_moments(const Tensor& value, const Tensor& gradient, const Tensor& exp_avg, const Tensor& exp_avg_sq);
void check_counter(const Tensor& step);
// count: of the Gaussians.
void check_statistics(const Tensor& max_radii, const Tensor& gradient_sums, const Tensor& views, const Tensor& radii,
                      int64_t count);

// Checks the inputs of a step's guard. `stopped`, one int64, comes with a loss of the parameters' dtype.
template <class T>
gs::StepGuard<T> step_guard(const Tensor& value, const MaybeTensor& loss, const MaybeTensor& stopped,
                            int64_t iteration) {
  if (!stopped) return {};
  GS_CHECK(loss && loss->numel() == 1 && alike(*loss, value), "a guarded step needs the loss, one ",
           value.scalar_type(), " on ", value.device());
  GS_CHECK(stopped->numel() == 1 && has_dtype(*stopped, ScalarType::Long) && stopped->device() == value.device(),
           "stopped must be one int64 on ", value.device(), ", got ", in_words(*stopped));
  GS_CHECK(iteration > 0, "iterations of guarded steps count from 1, got ", iteration);
  return {read<T>(*loss), write<int64_t>(*stopped), iteration};
}

inline int64_t rows_of(const Tensor& t) { return t.dim() > 0 ? t.size(0) : 1; }

// The tensors of one parameter as a backend takes them; all of them checked. columns: -1 for whole rows.
template <class T>
gs::AdamInput<T> adam_input(const Tensor& value, const Tensor& gradient, const Tensor& exp_avg,
                            const Tensor& exp_avg_sq, int64_t columns) {
  const int64_t rows = rows_of(value), row = rows ? value.numel() / rows : 0;
  GS_CHECK(rows == 0 || columns <= row, "columns must be at most ", row, ", got ", columns);
  gs::AdamInput<T> in{};
  in.value = write<T>(value), in.gradient = read<T>(gradient);
  in.mean = write<T>(exp_avg), in.square = write<T>(exp_avg_sq);
  in.rows = rows, in.row = row, in.columns = columns < 0 ? row : columns;
  return in;
}

}  // namespace gs::ops
