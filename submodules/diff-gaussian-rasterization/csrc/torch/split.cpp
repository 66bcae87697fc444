// The op that places the children of split Gaussians.
#include <ATen/ops/empty.h>

#include "tensors.h"

namespace gs::ops {

namespace {

Tensor split_positions_op(const Tensor& means, const Tensor& log_scales, const Tensor& rotations, const Tensor& items,
                          int64_t seed, int64_t stream, int64_t iteration, int64_t draw) {
  check_given(items, "items");
  const int64_t n = items.numel();
  check_tensor(items, "items", at::kLong, items.device(), {n});
  check_tensor(means, "means", at::kFloat, items.device(), {n, 3});
  check_tensor(log_scales, "log_scales", at::kFloat, items.device(), {n, 3});
  check_tensor(rotations, "rotations", at::kFloat, items.device(), {n, 4});
  const Tensor at_means = means.contiguous(), sizes = log_scales.contiguous(), turns = rotations.contiguous();
  const Tensor indices = items.contiguous();
  Tensor positions = at::empty({n, 3}, means.options());
  const gs::SplitInput in{n,
                          at_means.const_data_ptr<float>(),
                          sizes.const_data_ptr<float>(),
                          turns.const_data_ptr<float>(),
                          indices.const_data_ptr<int64_t>(),
                          uint64_t(seed),
                          uint32_t(draw),
                          uint32_t(iteration),
                          uint32_t(stream),
                          positions.mutable_data_ptr<float>()};
#ifdef GS_CUDA
  if (items.is_cuda()) {
    gs::TorchQueue queue(items.device());
    gs::cuda::split_positions(queue.queue(), in);
    return positions;
  }
#endif
  gs::split_positions(gs::torch_executor(), in);
  return positions;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(diff_gaussian_rasterization, m) {
  define(m,
         "split_positions(Tensor means, Tensor log_scales, Tensor rotations, Tensor items, int seed, int stream, "
         "int iteration, int draw) -> Tensor",
         &split_positions_op);
}

}  // namespace gs::ops
