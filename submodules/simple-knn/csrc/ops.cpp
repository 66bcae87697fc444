#include <ATen/ops/empty.h>
#include <torch/library.h>

#include "gs/torch_executor.h"
#include "launch.h"

namespace {

at::Tensor mean_distance2(const at::Tensor& points) {
  TORCH_CHECK(points.dim() == 2 && points.size(1) == 3, "points must be (N, 3), got ", points.sizes());
  TORCH_CHECK(points.scalar_type() == at::kFloat || points.scalar_type() == at::kDouble,
              "points must be float32 or float64, got ", points.scalar_type());
  const at::Tensor rows = points.contiguous();
  const int64_t n = rows.size(0);
  at::Tensor out = at::empty({n}, rows.options());
  if (rows.scalar_type() == at::kFloat)
    gs::mean_distance2_cpu(rows.const_data_ptr<float>(), n, out.mutable_data_ptr<float>(), gs::torch_executor());
  else
    gs::mean_distance2_cpu(rows.const_data_ptr<double>(), n, out.mutable_data_ptr<double>(), gs::torch_executor());
  return out;
}

}  // namespace

TORCH_LIBRARY(simple_knn, m) { m.def("mean_distance2(Tensor points) -> Tensor"); }

TORCH_LIBRARY_IMPL(simple_knn, CPU, m) { m.impl("mean_distance2", &mean_distance2); }
