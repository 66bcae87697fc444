// The ops of rendering: each stage by itself, and all of them in one.
#include <ATen/ops/empty.h>
#include <ATen/ops/topk.h>
#include <ATen/ops/zeros.h>

#include <algorithm>
#include <limits>

#include "backward.h"
#include "math/layers.h"
#include "math/splat.h"
#include "math/tiles.h"
#include "scene.h"

namespace gs::ops {

namespace {

using gs::baseline::kSplatValues, gs::baseline::layer_values, gs::baseline::tile_count, gs::baseline::tiles_of;

struct ProjectedTensors {
  Tensor splats, depths, rects, tile_counts, radii;
  Tensor records;  // undefined where an image has too many tiles
  template <class T>
  gs::Projected<T> pointers() {
    return {splats.mutable_data_ptr<T>(),
            depths.mutable_data_ptr<T>(),
            rects.defined() ? rects.mutable_data_ptr<int32_t>() : nullptr,
            tile_counts.mutable_data_ptr<int32_t>(),
            radii.mutable_data_ptr<int32_t>(),
            records.defined() ? static_cast<gs::TileRecord*>(records.mutable_data_ptr()) : nullptr};
  }
};

// rects: whether the caller wants them; with records nothing else needs them.
ProjectedTensors project(const SceneTensors& in, bool rects) {
  const int64_t n = in.count();
  const auto ints = in.options().dtype(at::kInt);
  ProjectedTensors out;
  out.splats = at::empty({n, kSplatValues}, in.options());
  out.depths = at::empty({n}, in.options());
  out.tile_counts = at::empty({n}, ints);
  out.radii = at::empty({n}, ints);
  const int most_tiles = tile_count(std::max(in.image().width, in.image().height));
  const bool records = most_tiles <= std::numeric_limits<uint16_t>::max();
  if (rects || !records) out.rects = at::empty({n, 4}, ints);
  if (records) out.records = at::empty({n, int64_t(sizeof(gs::TileRecord))}, in.options().dtype(at::kByte));
  with_scalar(in.dtype(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, out.splats, project, in.scene<T>(), out.pointers<T>());
  });
  return out;
}

// Names the Gaussians with the most tiles; often a few giants cover nearly all.
std::string giants(const Tensor& tile_counts) {
  const auto [counts, rows] = at::topk(tile_counts.cpu(), std::min<int64_t>(3, tile_counts.size(0)));
  std::string words;
  for (int64_t k = 0; k < counts.size(0); ++k)
    words += (k ? ", " : "") + std::to_string(rows.const_data_ptr<int64_t>()[k]) + " (" +
             std::to_string(counts.const_data_ptr<int32_t>()[k]) + ")";
  return words;
}

struct BinnedTensors {
  Tensor instances, ranges;
  Tensor splat_slots;  // (N + 1, 2): gs::SplatSlots, whose two 32-bit values share the second
  Tensor slots;        // (S, 0): only carries the number of slots, which sizes the backward's memory
};

// slots: whether the backward will need them.
BinnedTensors bin(ProjectedTensors& in, gs::Image image, bool slots) {
  const auto ints = in.depths.options().dtype(at::kInt), longs = in.depths.options().dtype(at::kLong);
  BinnedTensors out;
  out.splat_slots = at::empty({slots ? in.depths.size(0) + 1 : 0, 2}, longs);
  auto allocate = [&](int64_t total, int64_t slot_count) {
    const int64_t n = in.depths.size(0);
    TORCH_CHECK(total <= std::numeric_limits<int32_t>::max(), n, " Gaussians cover ", total,
                " tile instances, more than 2^31 - 1; most are those of Gaussian ", giants(in.tile_counts),
                ": remove such giants, or render at a lower resolution or with fewer Gaussians");
    out.instances = at::empty({total}, ints), out.ranges = at::empty({tiles_of(image) + 1}, longs);
    out.slots = at::empty({slot_count, 0}, ints);
    return gs::Binned{out.instances.mutable_data_ptr<int32_t>(), out.ranges.mutable_data_ptr<int64_t>()};
  };
  using Allocate = decltype(allocate);
  const gs::BinMemory memory{
      [](void* context, int64_t total, int64_t slots) { return (*static_cast<Allocate*>(context))(total, slots); },
      &allocate, slots ? static_cast<gs::SplatSlots*>(out.splat_slots.mutable_data_ptr()) : nullptr, ahead()};
  with_scalar(in.depths.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, in.depths, bin, in.depths.size(0), in.pointers<T>(), image, memory);
  });
  return out;
}

struct BlendedTensors {
  Tensor color, transmittance, inverse_depth, last;
  Tensor layers;  // (V): gs::Blended::layers, of no values on the CPU
};

// train: whether a backward will follow, for which the forward makes `last` and layers.
BlendedTensors blend(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& background,
                     gs::Image image, bool inverse_depth, bool train) {
  const int64_t h = image.height, w = image.width;
  const bool layers = train && splats.is_cuda();
  BlendedTensors out{at::empty({3, h, w}, splats.options()), at::empty({1, h, w}, splats.options()),
                     at::empty({inverse_depth ? 1 : 0, h, w}, splats.options()),
                     at::empty({train ? h : 0, w}, splats.options().dtype(at::kInt)),
                     at::empty({layers ? layer_values(image, instances.size(0), inverse_depth) : 0}, splats.options())};
  const Tensor bg = background_like(background, splats);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::Blended<T> blended{out.color.mutable_data_ptr<T>(), out.transmittance.mutable_data_ptr<T>(),
                                 inverse_depth ? out.inverse_depth.mutable_data_ptr<T>() : nullptr,
                                 train ? out.last.mutable_data_ptr<int32_t>() : nullptr,
                                 out.layers.numel() ? out.layers.mutable_data_ptr<T>() : nullptr};
    GS_RUN(T, splats, blend, blend_input<T>(splats, instances, ranges, bg, image), blended);
  });
  return out;
}

using Tensors5 = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;
using Tensors4 = std::tuple<Tensor, Tensor, Tensor, Tensor>;

Tensors5 project_op(SCENE_PARAMETERS) {
  const ProjectedTensors p = project(SceneTensors(SCENE_ARGUMENTS), true);
  return {p.splats, p.depths, p.rects, p.tile_counts, p.radii};
}

Tensors4 bin_op(const Tensor& splats, const Tensor& depths, const Tensor& rects, const Tensor& tile_counts,
                int64_t height, int64_t width, bool train) {
  check_splats(splats);
  const at::Device device = splats.device();
  const int64_t n = splats.size(0);
  check_tensor(depths, "depths", splats.scalar_type(), device, {n});
  check_tensor(rects, "rects", at::kInt, device, {n, 4});
  check_counts(tile_counts, n, device);
  ProjectedTensors p;
  p.splats = splats.contiguous(), p.depths = depths.contiguous(), p.rects = rects.contiguous();
  p.tile_counts = p.radii = tile_counts.contiguous();
  const BinnedTensors b = bin(p, checked_image(height, width), train);
  return {b.instances, b.ranges, b.splat_slots, b.slots};
}

Tensors5 blend_op(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& background,
                  int64_t height, int64_t width, bool inverse_depth, bool train) {
  check_splats(splats);
  const gs::Image image = checked_image(height, width);
  check_lists(instances, ranges, splats, image);
  const BlendedTensors b =
      blend(splats.contiguous(), instances.contiguous(), ranges.contiguous(), background, image, inverse_depth, train);
  return {b.color, b.transmittance, b.inverse_depth, b.last, b.layers};
}

using Rasterized =
    std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// absolute: what the backward that autograd runs gets; the forward does not depend on it.
Rasterized rasterize_op(const Tensor& means2d, SCENE_PARAMETERS, const Tensor& background, bool inverse_depth,
                        bool train, bool /*absolute*/) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  scene.checked(kMeans2d, means2d);  // it only receives a gradient
  ProjectedTensors p = project(scene, false);
  BinnedTensors b = bin(p, scene.image(), train);
  BlendedTensors o = blend(p.splats, b.instances, b.ranges, background, scene.image(), inverse_depth, train);
  return {o.color,     o.transmittance, o.inverse_depth, p.radii, p.splats, p.tile_counts,
          b.instances, b.ranges,        b.splat_slots,   b.slots, o.last,   o.layers};
}

Tensor mark_visible_op(const Tensor& means, const Tensor& view) {
  check_given(means, "positions");
  TORCH_CHECK_VALUE(means.dim() == 2 && means.size(1) == 3, "positions must be (N, 3), got ", in_words(means.sizes()));
  check_precise(view, "the view matrix", {4, 4});
  const Tensor rows = means.contiguous(), matrix = converted(view, means);
  Tensor visible = at::empty({rows.size(0)}, rows.options().dtype(at::kBool));
  with_scalar(rows.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, rows, mark_visible, rows.size(0), rows.const_data_ptr<T>(), matrix.const_data_ptr<T>(),
           visible.mutable_data_ptr<bool>());
  });
  return visible;
}

Tensor decisive_op(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& last) {
  check_splats(splats);
  const gs::Image image = image_of(last, splats);
  check_lists(instances, ranges, splats, image);
  Tensor decisive = at::zeros({splats.size(0)}, splats.options().dtype(at::kBool));
  const Tensor rows = splats.contiguous(), no_background = at::zeros({3}, splats.options());
  const Tensor lists = instances.contiguous(), bounds = ranges.contiguous(), ends = last.contiguous();
  with_scalar(rows.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, rows, mark_decisive, blend_input<T>(rows, lists, bounds, no_background, image),
           ends.const_data_ptr<int32_t>(), decisive.mutable_data_ptr<bool>());
  });
  return decisive;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(diff_gaussian_rasterization, m) {
  define(m,
         "project(" SCENE_SCHEMA ") -> (Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, Tensor radii)",
         &project_op);
  define(m,
         "bin(Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, int height, int width, bool train) -> "
         "(Tensor instances, Tensor ranges, Tensor splat_slots, Tensor slots)",
         &bin_op);
  define(m,
         "blend(Tensor splats, Tensor instances, Tensor ranges, Tensor background, int height, int width, "
         "bool inverse_depth, bool train) -> (Tensor color, Tensor transmittance, Tensor inverse_depth, Tensor last, "
         "Tensor layers)",
         &blend_op);
  define(
      m,
      "rasterize(Tensor means2d, " SCENE_SCHEMA
      ", Tensor background, bool inverse_depth, bool train, bool absolute=False) -> (Tensor color, "
      "Tensor transmittance, Tensor inverse_depth, Tensor radii, Tensor splats, Tensor tile_counts, Tensor instances, "
      "Tensor ranges, Tensor splat_slots, Tensor slots, Tensor last, Tensor layers)",
      &rasterize_op);
  define(m, "mark_visible(Tensor means, Tensor view) -> Tensor", &mark_visible_op);
  define(m, "decisive(Tensor splats, Tensor instances, Tensor ranges, Tensor last) -> Tensor", &decisive_op);
}

}  // namespace gs::ops
