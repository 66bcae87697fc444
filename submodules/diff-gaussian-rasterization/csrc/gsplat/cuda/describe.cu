// What programs for gsplat give and read. A thread takes a splat.
#include <cuda_runtime.h>
#include <thrust/iterator/counting_iterator.h>

#include <cub/cub.cuh>

#include "cuda/queue/host_numbers.cuh"
#include "cuda/queue/queue.cuh"
#include "gsplat/backend.h"
#include "gsplat/math/describe.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads)
    describe_kernel(const int32_t* halted, DescribeInput<float> in, Descriptions<float> out) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.count) baseline::describe_splat(in, out, i);
}

__global__ void __launch_bounds__(kThreads)
    describe_vjp_kernel(const int32_t* halted, DescribedInput<float> in, DescribedGradient<float> out) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.count) baseline::describe_vjp_splat(in, out, i);
}

struct IsShown {
  DescribeInput<float> in;
  __host__ __device__ bool operator()(int64_t i) const {
#ifdef __CUDA_ARCH__
    return baseline::extent_of(in, i, baseline::shape_of(in, i)).shown;
#endif
    return false;
  }
};

template <class T>
__global__ void pinhole_kernel(const int32_t* halted, const T* pose, const T* intrinsics, Image image,
                               PinholeMatrices<T> out) {
  if (begin_work(halted)) baseline::make_pinhole(pose, intrinsics, image, out);
}

}  // namespace

void describe(const Queue& queue, const DescribeInput<float>& in, const Descriptions<float>& out) {
  if (in.count) launch(queue, "describe", describe_kernel, blocks_for(in.count, kThreads), kThreads, in, out);
}

int64_t list_shown(const Queue& queue, const DescribeInput<float>& in, int64_t* rows) {
  if (!in.count) return 0;
  int64_t* shown = queue.array<int64_t>(1);
  const thrust::counting_iterator<int64_t> all(0);
  with_memory(queue, [&](void* memory, size_t& bytes) {
    return cub::DeviceSelect::If(memory, bytes, all, rows, shown, in.count, IsShown{in}, stream_of(queue));
  });
  return *HostNumbers<int64_t>(queue, shown, 1).wait();
}

void describe_vjp(const Queue& queue, const DescribedInput<float>& in, const DescribedGradient<float>& out) {
  if (in.count) launch(queue, "describe_vjp", describe_vjp_kernel, blocks_for(in.count, kThreads), kThreads, in, out);
}

template <class T>
void pinhole(const Queue& queue, const T* pose, const T* intrinsics, Image image, const PinholeMatrices<T>& out) {
  launch(queue, "pinhole", pinhole_kernel<T>, 1u, 1, pose, intrinsics, image, out);
}
template void pinhole<float>(const Queue&, const float*, const float*, Image, const PinholeMatrices<float>&);
template void pinhole<double>(const Queue&, const double*, const double*, Image, const PinholeMatrices<double>&);

}  // namespace cuda
}  // namespace gs
