// The ops of a tensor whose rows step late: the steps they have missed, and memory of the host for them.
#include <algorithm>

#include "math/adam.h"
#include "optim.h"

#ifdef GS_CUDA
#include "gs/cuda_check.h"

// In torch from 2.11 on.
extern "C" __attribute__((weak)) AOTITorchError torch_from_blob(
    void* data, int64_t axes, const int64_t* sizes, const int64_t* strides, int64_t offset, int32_t dtype,
    int32_t device_type, int32_t device_index, AtenTensorHandle* made, int32_t layout, const uint8_t* metadata,
    int64_t metadata_size, void (*release)(void* data, void* context), void* context);
#endif

namespace gs::ops {

namespace {

// The constants (steps, 7) of past steps, on the device of the values.
template <class T>
Tensor constants_of(const Tensor& value, List<double> rates, List<double> steps, double beta1, double beta2,
                    double eps) {
  using Step = gs::baseline::AdamStep<T>;
  static_assert(sizeof(Step) == 7 * sizeof(T), "AdamStep has seven numbers");
  const Tensor table = torch::stable::empty({int64_t(steps.size()), 7}, value.scalar_type());
  auto* row = reinterpret_cast<Step*>(write<T>(table));
  for (size_t k = 0; k < steps.size(); ++k)
    row[k] = gs::baseline::make_adam_step<T>(rates[k], beta1, beta2, eps, steps[k]);
  return value.is_cpu() ? table : torch::stable::to(table, value.device());
}

// Row r takes the steps from number taken[r] on, without a gradient: the bits that adam_ gives it with zeros. A value
// whose step is not finite is marked as under a guard, which has stopped nothing then.
void catch_up_op(Tensor& value, Tensor& exp_avg, Tensor& exp_avg_sq, const Tensor& taken, List<double> rates,
                 List<double> steps, double beta1, double beta2, double eps, int64_t columns) {
  check_moments(value, value, exp_avg, exp_avg_sq);
  check_tensor(taken, "taken", ScalarType::Int, value.device(), {rows_of(value)});
  GS_CHECK_VALUE(rates.size() == steps.size(), "give a rate for each of the ", steps.size(), " steps, got ",
                 rates.size());
  if (value.numel() == 0 || steps.empty()) return;
  const Tensor counts = packed(taken);
  with_scalar(value.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::AdamInput<T> in = adam_input<T>(value, value, exp_avg, exp_avg_sq, columns);
    const Tensor table = constants_of<T>(value, rates, steps, beta1, beta2, eps);
    const gs::MissedSteps<T> missed{read<T>(table), read<int32_t>(counts), int32_t(steps.size())};
    GS_RUN(T, value, catch_up, in, missed);
  });
}

void check_values(const Tensor& values) {
  check_given(values, "values");
  int32_t layout = 0;
  aoti_torch_get_layout(values.get(), &layout);
  GS_CHECK(layout == aoti_torch_layout_strided(), "values must be dense");
  with_scalar(values.scalar_type(), [](auto) {});
}

#ifdef GS_CUDA
void* host_memory(size_t bytes) {
  void* place = nullptr;
  const bool found = cudaHostAlloc(&place, std::max<size_t>(bytes, 1), cudaHostAllocDefault) == cudaSuccess;
  if (!found) cudaGetLastError();  // so that nobody else meets the error
  GS_CHECK(found, "OutOfMemoryError: the host is out of memory: ", bytes,
           " bytes of page-locked memory were asked for");
  return place;
}

// A tensor of the GPU in such memory, which it frees at its end, with the shape and dtype of `like`.
Tensor on_gpu(void* place, const Tensor& like) {
  const auto release = [](void* memory, void*) {
    cudaDeviceSynchronize();  // kernels may still use it
    cudaFreeHost(memory);
  };
  int32_t dtype = 0;
  aoti_torch_get_dtype(like.get(), &dtype);
  const Shape strides = strides_of(like.sizes());
  AtenTensorHandle made = nullptr;
  TORCH_ERROR_CODE_CHECK(torch_from_blob(place, strides.size(), like.sizes().data(), strides.data(), 0, dtype,
                                         aoti_torch_device_type_cuda(), like.get_device_index(), &made,
                                         aoti_torch_layout_strided(), nullptr, 0, release, nullptr));
  return Tensor(made);
}
#endif

// A copy in page-locked memory of the host that is yet a tensor of the GPU: kernels read and write it over the bus. A
// plain copy on the CPU.
Tensor in_host_memory_op(const Tensor& values) {
  check_values(values);
#ifdef GS_CUDA
  if (values.is_cuda()) {
    GS_CHECK(torch_from_blob, "memory of the host for a GPU's tensors needs torch 2.11 or newer: update torch");
    const torch::stable::accelerator::DeviceGuard guard(values.get_device_index());
    Tensor copy = on_gpu(host_memory(values.numel() * values.element_size()), values);
    return torch::stable::copy_(copy, values);
  }
#endif
  return torch::stable::clone(values);
}

// Whether `in_host_memory` has put it there.
bool is_in_host_memory_op(const Tensor& values) {
  check_values(values);
#ifdef GS_CUDA
  if (values.is_cuda() && values.numel() != 0) {
    cudaPointerAttributes found{};
    GS_CUDA_CHECK(cudaPointerGetAttributes(&found, values.const_data_ptr()));
    return found.type == cudaMemoryTypeHost;
  }
#endif
  return !values.is_cuda();
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "catch_up_(Tensor(a!) value, Tensor(b!) exp_avg, Tensor(c!) exp_avg_sq, Tensor taken, float[] rates, "
      "float[] steps, float beta1, float beta2, float eps, int columns=-1) -> ()",
      TORCH_BOX(&catch_up_op));
  m.define("in_host_memory(Tensor values) -> Tensor", TORCH_BOX(&in_host_memory_op));
  m.define("is_in_host_memory(Tensor values) -> bool", TORCH_BOX(&is_in_host_memory_op));
}

}  // namespace gs::ops
