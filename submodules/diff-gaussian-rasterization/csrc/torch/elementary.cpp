// The ops of exponentials, logarithms and random numbers that are the same bits on every device.
#include "tensors.h"

namespace gs::ops {

namespace {

Tensor apply(const Tensor& values, bool logarithm) {
  check_given(values, "values");
  GS_CHECK_TYPE(has_dtype(values, ScalarType::Double), "values must be float64, got ", values.scalar_type());
  const Tensor from = packed(values);
  const Tensor out = empty(from.sizes(), from);
  const gs::Elementary in{from.numel(), read<double>(from), write<double>(out), logarithm};
  run_at(from, [&](const auto& where) { gs::elementary(where, in); }, halted());
  return out;
}

Tensor exp_op(const Tensor& values) { return apply(values, false); }
Tensor log_op(const Tensor& values) { return apply(values, true); }

// items: (n), decide the numbers with what follows. Returns (n, 4) below 2^32.
Tensor random_words_op(const Tensor& items, int64_t seed, int64_t stream, int64_t iteration, int64_t draw) {
  check_given(items, "items");
  check_tensor(items, "items", ScalarType::Long, items.device(), {-1});
  const Tensor from = packed(items);
  const Tensor out = empty<int64_t>({from.size(0), 4}, from);
  gs::RandomInput in{from.size(0), read<int64_t>(from), write<int64_t>(out), uint64_t(seed)};
  in.stream = uint32_t(stream), in.iteration = uint32_t(iteration), in.draw = uint32_t(draw);
  run_at(from, [&](const auto& where) { gs::random_words(where, in); }, halted());
  return out;
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define("exp(Tensor values) -> Tensor", TORCH_BOX(&exp_op));
  m.define("log(Tensor values) -> Tensor", TORCH_BOX(&log_op));
  m.define("random_words(Tensor items, int seed, int stream, int iteration, int draw) -> Tensor",
           TORCH_BOX(&random_words_op));
}

}  // namespace gs::ops
