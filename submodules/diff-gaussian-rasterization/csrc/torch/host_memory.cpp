// The op that puts tensors of a GPU into memory of the host.
#include <algorithm>

#include "tensors.h"

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

// Whether a tensor is in memory of the host.
bool is_in_host_memory(const Tensor& values) {
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

// A copy in page-locked memory of the host that is yet a tensor of the GPU: kernels read and write it over the bus.
// Null if `values` lie there already, or on the CPU, or if `beside` is given and does not lie there.
MaybeTensor in_host_memory_op(const Tensor& values, const MaybeTensor& beside) {
  if (is_in_host_memory(values) || (beside && !is_in_host_memory(*beside))) return {};
#ifdef GS_CUDA
  GS_CHECK(torch_from_blob, "memory of the host for a GPU's tensors needs torch 2.11 or newer: update torch");
  const torch::stable::accelerator::DeviceGuard guard(values.get_device_index());
  Tensor copy = on_gpu(host_memory(values.numel() * values.element_size()), values);
  return torch::stable::copy_(copy, values);
#else
  return {};
#endif
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define("in_host_memory(Tensor values, Tensor? beside=None) -> Tensor?", TORCH_BOX(&in_host_memory_op));
}

}  // namespace gs::ops
