// The ops of a tensor whose rows step late: the steps they have missed, and memory of the host for them.
#include <ATen/ops/empty.h>
#ifdef GS_CUDA
#include <ATen/ops/from_blob.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <cuda_runtime.h>
#endif

#include <algorithm>

#include "math/adam.h"
#include "optim.h"

namespace gs::ops {

namespace {

// The constants (steps, 7) of past steps, on the device of the values.
template <class T>
Tensor constants_of(const Tensor& value, at::ArrayRef<double> rates, at::ArrayRef<double> steps, double beta1,
                    double beta2, double eps) {
  using Step = gs::baseline::AdamStep<T>;
  static_assert(sizeof(Step) == 7 * sizeof(T), "AdamStep has seven numbers");
  const Tensor table = at::empty({int64_t(steps.size()), 7}, value.options().device(at::kCPU));
  auto* row = reinterpret_cast<Step*>(table.mutable_data_ptr<T>());
  for (size_t k = 0; k < steps.size(); ++k)
    row[k] = gs::baseline::make_adam_step<T>(rates[k], beta1, beta2, eps, steps[k]);
  return table.to(value.device());
}

// Row r takes the steps from number taken[r] on, without a gradient: the bits that adam_ gives it with zeros. A value
// whose step is not finite is marked as under a guard, which has stopped nothing then.
void catch_up_op(Tensor& value, Tensor& exp_avg, Tensor& exp_avg_sq, const Tensor& taken, at::ArrayRef<double> rates,
                 at::ArrayRef<double> steps, double beta1, double beta2, double eps, int64_t columns) {
  check_moments(value, value, exp_avg, exp_avg_sq);
  check_tensor(taken, "taken", at::kInt, value.device(), {rows_of(value)});
  TORCH_CHECK_VALUE(rates.size() == steps.size(), "give a rate for each of the ", steps.size(), " steps, got ",
                    rates.size());
  if (value.numel() == 0 || steps.empty()) return;
  const Tensor counts = taken.contiguous();
  with_scalar(value.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::AdamInput<T> in = adam_input<T>(value, value, exp_avg, exp_avg_sq, columns);
    const Tensor table = constants_of<T>(value, rates, steps, beta1, beta2, eps);
    const gs::MissedSteps<T> missed{table.const_data_ptr<T>(), counts.const_data_ptr<int32_t>(), int32_t(steps.size())};
    GS_RUN(T, value, catch_up, in, missed);
  });
}

void check_values(const Tensor& values) {
  check_given(values, "values");
  TORCH_CHECK(values.layout() == at::kStrided, "values must be dense, got ", values.layout());
  with_scalar(values.scalar_type(), [](auto) {});
}

// A copy in page-locked memory of the host that is yet a tensor of the GPU: kernels read and write it over the bus. A
// plain copy on the CPU.
Tensor in_host_memory_op(const Tensor& values) {
  check_values(values);
#ifdef GS_CUDA
  if (values.is_cuda()) {
    const c10::cuda::CUDAGuard guard(values.device());
    void* place = nullptr;
    if (cudaHostAlloc(&place, std::max<size_t>(values.nbytes(), 1), cudaHostAllocDefault) != cudaSuccess) {
      cudaGetLastError();  // so that nobody else meets the error
      TORCH_CHECK_WITH(OutOfMemoryError, false, "the host is out of memory: ", values.nbytes(),
                       " bytes of page-locked memory were asked for");
    }
    const auto release = [](void* memory) {
      cudaDeviceSynchronize();  // kernels may still use it
      cudaFreeHost(memory);
    };
    return at::from_blob(place, values.sizes(), release, values.options(), values.device()).copy_(values);
  }
#endif
  return values.clone();
}

// Whether `in_host_memory` has put it there.
bool is_in_host_memory_op(const Tensor& values) {
  check_values(values);
#ifdef GS_CUDA
  if (values.is_cuda() && values.numel() != 0) {
    cudaPointerAttributes found{};
    C10_CUDA_CHECK(cudaPointerGetAttributes(&found, values.const_data_ptr()));
    return found.type == cudaMemoryTypeHost;
  }
#endif
  return !values.is_cuda();
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(diff_gaussian_rasterization, m) {
  define(m,
         "catch_up_(Tensor(a!) value, Tensor(b!) exp_avg, Tensor(c!) exp_avg_sq, Tensor taken, float[] rates, "
         "float[] steps, float beta1, float beta2, float eps, int columns=-1) -> ()",
         &catch_up_op);
  define(m, "in_host_memory(Tensor values) -> Tensor", &in_host_memory_op);
  define(m, "is_in_host_memory(Tensor values) -> bool", &is_in_host_memory_op);
}

}  // namespace gs::ops
