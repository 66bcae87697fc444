// The ops of what programs for gsplat give and read.
#include "gsplat/backend.h"
#include "torch/backward.h"

namespace gs::ops {

namespace {

// Calls run(T(), queue or executor), on the device of `like`; kWide: whether a GPU knows float64.
template <bool kWide, class Run>
void on_device(const Tensor& like, const Run& run) {
  with_scalar(like.scalar_type(), [&](auto zero) {
    if (!like.is_cuda()) return run(zero, gs::torch_executor());
#ifdef GS_CUDA
    if constexpr (kWide || std::is_same_v<decltype(zero), float>) {
      gs::TorchQueue queue(like.device());
      return run(zero, queue.queue());
    }
#endif
    GS_CHECK(false, kFloatAlone);
  });
}

// Splats that keep their shapes as programs for gsplat know them, zeros where they are not shown (math/describe.h); if
// packed those that are shown, and then also their tiles and their numbers.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> describe_op(
    const Tensor& splats, const Tensor& depths, const Tensor& tile_counts, int64_t height, int64_t width, bool packed) {
  check_splats(splats);
  const int64_t n = splats.size(0);
  check_tensor(depths, "depths", splats.scalar_type(), splats.device(), {n});
  check_counts(tile_counts, n, splats.device());
  const gs::Image image = checked_image(height, width);
  const Tensor values = gs::packed(splats), from = gs::packed(depths), counts = gs::packed(tile_counts);
  Tensor rows = empty<int64_t>({packed ? n : 0}, splats);
  Tensor radii, centers, to, conics, opacities, tiles;
  on_device<false>(splats, [&](auto zero, const auto& where) {
    using T = decltype(zero);
    gs::DescribeInput<T> in{n,    nullptr, int(splats.size(1)), read<T>(values), read<T>(from), read<int32_t>(counts),
                            image};
    const int64_t shown = in.count = packed ? list_shown(where, in, write<int64_t>(rows)) : n;
    radii = empty<int32_t>({shown, 2}, splats), centers = empty({shown, 2}, splats), to = empty({shown}, splats);
    conics = empty({shown, 3}, splats), opacities = empty({shown}, splats);
    tiles = empty<int32_t>({packed ? shown : 0}, splats);
    if (packed) rows = torch::stable::narrow(rows, 0, 0, shown), in.rows = read<int64_t>(rows);
    describe(where, in,
             gs::Descriptions<T>{write<int32_t>(radii), write<T>(centers), write<T>(to), write<T>(conics),
                                 write<T>(opacities), packed ? write<int32_t>(tiles) : nullptr});
  });
  return {radii, centers, to, conics, opacities, tiles, rows};
}

// The gradients of the description of which these are the moments: of centers, conics and opacities. rows: those of a
// packed description.
std::tuple<Tensor, Tensor, Tensor> describe_vjp_op(const Tensor& splats, const Tensor& tile_counts,
                                                   const Tensor& moments, const MaybeTensor& rows) {
  check_staged(splats);
  const int64_t n = splats.size(0);
  check_counts(tile_counts, n, splats.device());
  check_tensor(moments, "moments", splats.scalar_type(), splats.device(), {n, splats.size(1)});
  if (given(rows)) check_tensor(*rows, "rows", ScalarType::Long, splats.device(), {-1});
  const Tensor values = packed(splats), from = packed(moments), counts = packed(tile_counts);
  const Tensor listed = given(rows) ? packed(*rows) : Tensor();
  const int64_t shown = listed.defined() ? listed.size(0) : n;
  const Tensor centers = empty({shown, 2}, splats), conics = empty({shown, 3}, splats);
  const Tensor opacities = empty({shown}, splats);
  on_device<false>(splats, [&](auto zero, const auto& where) {
    using T = decltype(zero);
    const gs::DescribedInput<T> in{shown,
                                   listed.defined() ? read<int64_t>(listed) : nullptr,
                                   int(splats.size(1)),
                                   read<T>(values),
                                   read<T>(from),
                                   read<int32_t>(counts)};
    describe_vjp(where, in, gs::DescribedGradient<T>{write<T>(centers), write<T>(conics), write<T>(opacities)});
  });
  return {centers, conics, opacities};
}

// A view (4, 4) and intrinsics (3, 3) as Scene's view, projection and center.
std::tuple<Tensor, Tensor, Tensor> pinhole_op(const Tensor& pose, const Tensor& intrinsics, int64_t height,
                                              int64_t width) {
  check_precise(pose, "a view matrix", {4, 4});
  check_precise(intrinsics, "intrinsics", {3, 3});
  const gs::Image image = checked_image(height, width);
  const Tensor from = packed(pose), K = converted(intrinsics, pose);
  const Tensor view = empty({4, 4}, pose), projection = empty({4, 4}, pose), center = empty({3}, pose);
  on_device<true>(pose, [&](auto zero, const auto& where) {
    using T = decltype(zero);
    pinhole(where, read<T>(from), read<T>(K), image,
            gs::PinholeMatrices<T>{write<T>(view), write<T>(projection), write<T>(center)});
  });
  return {view, projection, center};
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "describe(Tensor splats, Tensor depths, Tensor tile_counts, int height, int width, bool packed=False) -> (Tensor "
      "radii, Tensor centers, "
      "Tensor depths, Tensor conics, Tensor opacities, Tensor tiles, Tensor rows)",
      TORCH_BOX(&describe_op));
  m.define(
      "describe_vjp(Tensor splats, Tensor tile_counts, Tensor moments, Tensor? rows=None) -> (Tensor centers, "
      "Tensor conics, Tensor opacities)",
      TORCH_BOX(&describe_vjp_op));
  m.define(
      "pinhole(Tensor pose, Tensor intrinsics, int height, int width) -> (Tensor view, Tensor projection, "
      "Tensor center)",
      TORCH_BOX(&pinhole_op));
}

}  // namespace gs::ops
