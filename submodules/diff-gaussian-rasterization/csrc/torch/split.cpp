// The op that places the children of split Gaussians.

#include "tensors.h"

namespace gs::ops {

namespace {

Tensor split_positions_op(const Tensor& means, const Tensor& log_scales, const Tensor& rotations, const Tensor& items,
                          int64_t seed, int64_t stream, int64_t iteration, int64_t draw) {
  check_given(items, "items");
  const int64_t n = items.numel();
  check_tensor(items, "items", ScalarType::Long, items.device(), {n});
  check_tensor(means, "means", ScalarType::Float, items.device(), {n, 3});
  check_tensor(log_scales, "log_scales", ScalarType::Float, items.device(), {n, 3});
  check_tensor(rotations, "rotations", ScalarType::Float, items.device(), {n, 4});
  const Tensor at_means = packed(means), sizes = packed(log_scales), turns = packed(rotations);
  const Tensor indices = packed(items);
  Tensor positions = empty({n, 3}, means);
  const gs::SplitInput in{n,
                          read<float>(at_means),
                          read<float>(sizes),
                          read<float>(turns),
                          read<int64_t>(indices),
                          uint64_t(seed),
                          uint32_t(draw),
                          uint32_t(iteration),
                          uint32_t(stream),
                          write<float>(positions)};
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

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "split_positions(Tensor means, Tensor log_scales, Tensor rotations, Tensor items, int seed, int stream, "
      "int iteration, int draw) -> Tensor",
      TORCH_BOX(&split_positions_op));
}

}  // namespace gs::ops
