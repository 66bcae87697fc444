// The op of the mean squared distance to the nearest points.
#include <limits>

#include "backend.h"
#include "gs/torch_executor.h"
#include "gs/torch_operators.h"
#include "gs/torch_tensor.h"

namespace gs {

namespace {

template <class T>
void fill_mean_distance2(const Tensor& rows, const Tensor& out) {
  run_at(rows, [&](const auto& where) { mean_distance2(read<T>(rows), rows.size(0), write<T>(out), where); });
}

Tensor mean_distance2_op(const Tensor& points) {
  check_given(points, "points");
  GS_CHECK(points.dim() == 2 && points.size(1) == 3, "points must be (N, 3), got ", points.sizes());
  const ScalarType type = points.scalar_type();
  GS_CHECK(is_floating(type), "points must be float32 or float64, got ", type);
  GS_CHECK(points.is_cpu() || points.size(0) <= std::numeric_limits<int32_t>::max(),
           "the CUDA backend takes fewer than 2^31 points, got ", points.size(0), ": pass points.cpu()");
  const Tensor rows = packed(points), out = empty({rows.size(0)}, rows);
  type == ScalarType::Float ? fill_mean_distance2<float>(rows, out) : fill_mean_distance2<double>(rows, out);
  return out;
}

}  // namespace

GS_OPERATORS(simple_knn, m) { m.define("mean_distance2(Tensor points) -> Tensor", TORCH_BOX(&mean_distance2_op)); }

}  // namespace gs
