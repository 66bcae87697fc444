// The op that adds noise to the centres of Gaussians.
#include "tensors.h"

namespace gs::ops {

namespace {

void add_noise_op(Tensor& means, const Tensor& log_scales, const Tensor& rotations, const Tensor& logits, double size,
                  double steepness, double threshold, int64_t seed, int64_t stream, int64_t iteration,
                  const MaybeTensor& stopped, int64_t first) {
  check_given(means, "means");
  const int64_t n = means.dim() > 0 ? means.size(0) : 0;
  check_tensor(means, "means", ScalarType::Float, means.device(), {n, 3});
  check_tensor(log_scales, "log_scales", ScalarType::Float, means.device(), {n, 3});
  check_tensor(rotations, "rotations", ScalarType::Float, means.device(), {n, 4});
  check_tensor(logits, "logits", ScalarType::Float, means.device(), {n, 1});
  if (stopped) check_tensor(*stopped, "stopped", ScalarType::Long, means.device(), {1});
  GS_CHECK_VALUE(means.is_contiguous(), "means must be contiguous");
  GS_CHECK_VALUE(size >= 0 && steepness >= 0 && steepness <= 10000, "size must be at least 0 and steepness from 0 to ",
                 "10000, got ", size, " and ", steepness);
  const Tensor sizes = packed(log_scales), turns = packed(rotations), opacities = packed(logits);
  const gs::NoiseInput in{n,
                          write<float>(means),
                          read<float>(sizes),
                          read<float>(turns),
                          read<float>(opacities),
                          size,
                          steepness,
                          threshold,
                          uint64_t(seed),
                          uint32_t(iteration),
                          uint32_t(stream),
                          stopped ? read<int64_t>(*stopped) : nullptr,
                          first};
#ifdef GS_CUDA
  if (means.is_cuda()) {
    gs::TorchQueue queue(means.device(), halted());
    return gs::cuda::add_noise(queue.queue(), in);
  }
#endif
  gs::add_noise(gs::torch_executor(), in);
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "add_noise_(Tensor(a!) means, Tensor log_scales, Tensor rotations, Tensor logits, float size, "
      "float steepness, float threshold, int seed, int stream, int iteration, Tensor? stopped=None, int first=0) "
      "-> ()",
      TORCH_BOX(&add_noise_op));
}

}  // namespace gs::ops
