// The op of the mean squared distance to the nearest points.
#include <ATen/ops/empty.h>
#include <torch/library.h>

#include "backend.h"
#include "gs/torch_executor.h"

#ifdef GS_CUDA
#include <limits>

#include "gs/torch_queue.h"
#endif

namespace {

void check_points(const at::Tensor& points) {
  TORCH_CHECK(points.dim() == 2 && points.size(1) == 3, "points must be (N, 3), got ", points.sizes());
  TORCH_CHECK(points.scalar_type() == at::kFloat || points.scalar_type() == at::kDouble,
              "points must be float32 or float64, got ", points.scalar_type());
}

at::Tensor mean_distance2(const at::Tensor& points) {
  check_points(points);
  const at::Tensor rows = points.contiguous();
  const int64_t n = rows.size(0);
  at::Tensor out = at::empty({n}, rows.options());
  if (rows.scalar_type() == at::kFloat)
    gs::mean_distance2_cpu(rows.const_data_ptr<float>(), n, out.mutable_data_ptr<float>(), gs::torch_executor());
  else
    gs::mean_distance2_cpu(rows.const_data_ptr<double>(), n, out.mutable_data_ptr<double>(), gs::torch_executor());
  return out;
}

#ifdef GS_CUDA
at::Tensor mean_distance2_on_cuda(const at::Tensor& points) {
  check_points(points);
  TORCH_CHECK(points.size(0) <= std::numeric_limits<int32_t>::max(),
              "the CUDA backend takes fewer than 2^31 points, got ", points.size(0), ": pass points.cpu()");
  gs::TorchQueue queue(points.device());
  const at::Tensor rows = points.contiguous();
  const int64_t n = rows.size(0);
  at::Tensor out = at::empty({n}, rows.options());
  if (rows.scalar_type() == at::kFloat)
    gs::mean_distance2_cuda(rows.const_data_ptr<float>(), n, out.mutable_data_ptr<float>(), queue.queue());
  else
    gs::mean_distance2_cuda(rows.const_data_ptr<double>(), n, out.mutable_data_ptr<double>(), queue.queue());
  return out;
}
#endif

}  // namespace

TORCH_LIBRARY(simple_knn, m) { m.def("mean_distance2(Tensor points) -> Tensor"); }

TORCH_LIBRARY_IMPL(simple_knn, CPU, m) { m.impl("mean_distance2", &mean_distance2); }

#ifdef GS_CUDA
TORCH_LIBRARY_IMPL(simple_knn, CUDA, m) { m.impl("mean_distance2", &mean_distance2_on_cuda); }
#endif
