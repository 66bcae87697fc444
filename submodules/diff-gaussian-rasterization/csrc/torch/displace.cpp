// The op that moves Gaussians at random within their own shape.
#include "tensors.h"

namespace gs::ops {

namespace {

// Of each Gaussian, the mean moves: by noise that its opacity gates, or, without `logits`, to a child of a split one.
// items: indices in the model, which decide the random numbers; first: that of the first one, without them. gate: size,
// steepness and threshold.
void displace_op(Tensor& means, const Tensor& log_scales, const Tensor& rotations, const MaybeTensor& logits,
                 const MaybeTensor& items, List<double> gate, int64_t seed, int64_t stream, int64_t iteration,
                 int64_t draw, const MaybeTensor& stopped, int64_t first) {
  check_given(means, "means");
  const Device device = means.device();
  const int64_t n = means.dim() > 0 ? means.size(0) : 0;
  check_tensor(means, "means", ScalarType::Float, device, {n, 3});
  check_tensor(log_scales, "log_scales", ScalarType::Float, device, {n, 3});
  check_tensor(rotations, "rotations", ScalarType::Float, device, {n, 4});
  GS_CHECK_VALUE(logits.has_value() != items.has_value(), "give logits, or items");
  if (logits) check_tensor(*logits, "logits", ScalarType::Float, device, {n, 1});
  if (items) check_tensor(*items, "items", ScalarType::Long, device, {n});
  if (stopped) check_tensor(*stopped, "stopped", ScalarType::Long, device, {1});
  GS_CHECK_VALUE(means.is_contiguous(), "means must be contiguous");
  GS_CHECK_VALUE(gate.size() == (logits ? 3 : 0), "a gate goes with logits");
  GS_CHECK_VALUE(!logits || (gate[0] >= 0 && gate[1] >= 0 && gate[1] <= 10000),
                 "size must be at least 0 and steepness from 0 to 10000, got ", gate[0], " and ", gate[1]);
  const Tensor sizes = packed(log_scales), turns = packed(rotations), one = packed(logits ? *logits : *items);
  gs::Displacement in{n, write<float>(means), read<float>(sizes), read<float>(turns)};
  if (logits)
    in.logits = read<float>(one), in.size = gate[0], in.steepness = gate[1], in.threshold = gate[2];
  else
    in.items = read<int64_t>(one);
  in.seed = uint64_t(seed), in.stream = uint32_t(stream), in.iteration = uint32_t(iteration);
  in.draw = uint32_t(draw), in.first = first, in.stopped = stopped ? read<int64_t>(*stopped) : nullptr;
  run_at(means, [&](const auto& where) { gs::displace(where, in); }, halted());
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "displace_(Tensor(a!) means, Tensor log_scales, Tensor rotations, Tensor? logits, Tensor? items, float[] gate, "
      "int seed, int stream, int iteration, int draw=0, Tensor? stopped=None, int first=0) -> ()",
      TORCH_BOX(&displace_op));
}

}  // namespace gs::ops
