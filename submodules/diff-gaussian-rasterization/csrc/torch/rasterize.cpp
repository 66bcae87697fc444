// The ops of rendering: each stage by itself, and all of them in one.

#include <algorithm>
#include <limits>
#include <numeric>

#include "backward.h"
#include "math/layers.h"
#include "math/splat.h"
#include "math/tiles.h"

namespace gs::ops {

namespace {

using gs::baseline::has_records, gs::baseline::layer_values, gs::baseline::splat_row, gs::baseline::tiles_of;

struct ProjectedTensors {
  Tensor splats, depths, rects, tile_counts, radii;
  Tensor records;  // undefined where an image has too many tiles
  Tensor table;    // gs::Projected::table, undefined where there is none
  template <class T>
  gs::Projected<T> pointers() {
    return {write<T>(splats),
            write<T>(depths),
            rects.defined() ? write<int32_t>(rects) : nullptr,
            write<int32_t>(tile_counts),
            write<int32_t>(radii),
            records.defined() ? static_cast<gs::TileRecord*>(records.mutable_data_ptr()) : nullptr,
            rays_of(splats),
            table.defined() ? read<T>(table) : nullptr};
  }
};

// rects: whether the caller wants them; with records nothing else needs them.
ProjectedTensors project(const SceneTensors& in, bool rects) {
  const int64_t n = in.rows();
  const Tensor& like = in.means();
  ProjectedTensors out;
  out.splats = empty({n, splat_row(in.rays())}, like);
  out.depths = empty({n}, like);
  out.tile_counts = empty<int32_t>({n}, like);
  out.radii = empty<int32_t>({n}, like);
  const bool records = has_records(in.image());
  if (rects || !records) out.rects = empty<int32_t>({n, 4}, like);
  if (records) out.records = empty<uint8_t>({n, int64_t(sizeof(gs::TileRecord))}, like);
  out.table = in.table();
  with_scalar(in.dtype(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, out.splats, project, in.scene<T>(), out.pointers<T>());
  });
  return out;
}

// Names the Gaussians with the most tiles; often a few giants cover nearly all. blocks: of whose Gaussians the counts
// are (gs::Scene::blocks), if it is defined.
std::string giants(const Tensor& tile_counts, const Tensor& blocks) {
  const Tensor on_host = torch::stable::to(tile_counts, DeviceType::CPU);
  const auto* counts = read<int32_t>(on_host);
  std::vector<int64_t> rows(on_host.size(0));
  std::iota(rows.begin(), rows.end(), 0);
  const auto end = rows.begin() + std::min<size_t>(3, rows.size());
  std::partial_sort(rows.begin(), end, rows.end(), [&](int64_t a, int64_t b) { return counts[a] > counts[b]; });
  const Tensor listed = blocks.defined() ? torch::stable::to(blocks, DeviceType::CPU) : blocks;
  const auto gaussian = [&](int64_t row) {
    const int64_t place = row / gs::kSleepBlock;
    return row + (listed.defined() ? read<int32_t>(listed)[place] - place : 0) * gs::kSleepBlock;
  };
  std::string words;
  for (auto row = rows.begin(); row != end; ++row)
    words += (row == rows.begin() ? "" : ", ") + joined(gaussian(*row), " (", counts[*row], ")");
  return words;
}

struct BinnedTensors {
  Tensor instances, ranges;
  Tensor splat_slots;  // (N + 1, 2): gs::SplatSlots, whose two 32-bit values share the second
  Tensor slots;        // (S, 0): only carries the number of slots, which sizes the backward's memory
};

// slots: whether the backward will need them. blocks: as for `giants`.
BinnedTensors bin(ProjectedTensors& in, gs::Image image, bool slots, const Tensor& blocks = {}) {
  BinnedTensors out;
  out.splat_slots = empty<int64_t>({slots ? in.depths.size(0) + 1 : 0, 2}, in.depths);
  auto allocate = [&](int64_t total, int64_t slot_count) {
    const int64_t n = in.depths.size(0);
    GS_CHECK(total <= std::numeric_limits<int32_t>::max(), n, " Gaussians cover ", total,
             " tile instances, more than 2^31 - 1; most are those of Gaussian ", giants(in.tile_counts, blocks),
             ": remove such giants, or render at a lower resolution or with fewer Gaussians");
    out.instances = empty<int32_t>({total}, in.depths);
    out.ranges = empty<int64_t>({tiles_of(image) + 1}, in.depths);
    out.slots = empty<int32_t>({slot_count, 0}, in.depths);
    return gs::Binned{write<int32_t>(out.instances), write<int64_t>(out.ranges)};
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
                     gs::Image image, bool inverse_depth, bool train, const Tensor& table = {}) {
  const int64_t h = image.height, w = image.width;
  const bool layers = train && splats.is_cuda();
  BlendedTensors out{empty({3, h, w}, splats), empty({1, h, w}, splats), empty({inverse_depth ? 1 : 0, h, w}, splats),
                     empty<int32_t>({train ? h : 0, w}, splats),
                     empty({layers ? layer_values(image, instances.size(0), inverse_depth) : 0}, splats)};
  const Tensor bg = background_like(background, splats);
  with_scalar(splats.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::Blended<T> blended{
        write<T>(out.color), write<T>(out.transmittance), inverse_depth ? write<T>(out.inverse_depth) : nullptr,
        train ? write<int32_t>(out.last) : nullptr, out.layers.numel() ? write<T>(out.layers) : nullptr};
    GS_RUN(T, splats, blend, blend_input<T>(splats, instances, ranges, bg, image, table), blended);
  });
  return out;
}

using Tensors5 = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;
using Tensors4 = std::tuple<Tensor, Tensor, Tensor, Tensor>;

Tensors5 project_op(SCENE_PARAMETERS, const MaybeTensor& awake) {
  SceneTensors scene(SCENE_ARGUMENTS);
  scene.set_awake(given(awake));
  const ProjectedTensors p = project(scene, true);
  return {p.splats, p.depths, p.rects, p.tile_counts, p.radii};
}

// `project` and `bin` in one, so that a GPU makes records once; the lists are ordered by the depths.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> project_binned_op(SCENE_PARAMETERS,
                                                                                             bool train) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  ProjectedTensors p = project(scene, false);
  const BinnedTensors b = bin(p, scene.image(), train);
  return {p.splats, p.depths, p.tile_counts, p.radii, b.instances, b.ranges, b.splat_slots, b.slots};
}

Tensors4 bin_op(const Tensor& splats, const Tensor& depths, const Tensor& rects, const Tensor& tile_counts,
                int64_t height, int64_t width, bool train) {
  check_staged(splats);
  const Device device = splats.device();
  const int64_t n = splats.size(0);
  check_tensor(depths, "depths", splats.scalar_type(), device, {n});
  check_tensor(rects, "rects", ScalarType::Int, device, {n, 4});
  check_counts(tile_counts, n, device);
  ProjectedTensors p;
  p.splats = aligned(splats, 2), p.depths = packed(depths), p.rects = aligned(rects, 4);
  p.tile_counts = p.radii = packed(tile_counts);
  const BinnedTensors b = bin(p, checked_image(height, width), train);
  return {b.instances, b.ranges, b.splat_slots, b.slots};
}

Tensors5 blend_op(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& background,
                  int64_t height, int64_t width, bool inverse_depth, bool train) {
  check_staged(splats);
  const gs::Image image = checked_image(height, width);
  check_lists(instances, ranges, splats, image);
  const BlendedTensors b =
      blend(aligned(splats, 2), packed(instances), packed(ranges), background, image, inverse_depth, train);
  return {b.color, b.transmittance, b.inverse_depth, b.last, b.layers};
}

using Rasterized =
    std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// absolute, camera: what the backward that autograd runs gets; the forward does not depend on them.
Rasterized rasterize_op(const Tensor& means2d, SCENE_PARAMETERS, const Tensor& background, bool inverse_depth,
                        bool train, bool /*absolute*/, const MaybeTensor& awake, const MaybeTensor& /*camera*/) {
  SceneTensors scene(SCENE_ARGUMENTS);
  scene.set_awake(given(awake));
  scene.checked(kMeans2d, &means2d);  // it only receives a gradient
  ProjectedTensors p = project(scene, false);
  BinnedTensors b = bin(p, scene.image(), train, scene.blocks());
  BlendedTensors o = blend(p.splats, b.instances, b.ranges, background, scene.image(), inverse_depth, train, p.table);
  return {o.color,     o.transmittance, o.inverse_depth, p.radii, p.splats, p.tile_counts,
          b.instances, b.ranges,        b.splat_slots,   b.slots, o.last,   o.layers};
}

// lens: as in CAMERA_SCHEMA, of Gaussians on the rays of a lens.
Tensor decisive_op(const Tensor& splats, const Tensor& instances, const Tensor& ranges, const Tensor& last,
                   List<double> lens) {
  check_splats(splats);
  const gs::Image image = image_of(last, splats);
  check_lists(instances, ranges, splats, image);
  const bool through_lens = rays_of(splats) == gs::kLensRays;
  GS_CHECK_VALUE(!through_lens || lens.size() >= 3 + gs::kLensNumbers, "give the lens of splats on its rays");
  const Tensor table = through_lens ? table_of(lens.data() + 3, image, splats) : Tensor();
  Tensor decisive = torch::stable::new_zeros(splats, {splats.size(0)}, ScalarType::Bool);
  const Tensor rows = aligned(splats, 2), no_background = torch::stable::new_zeros(splats, {3});
  const Tensor lists = packed(instances), bounds = packed(ranges), ends = packed(last);
  with_scalar(rows.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, rows, mark_decisive, blend_input<T>(rows, lists, bounds, no_background, image, table),
           read<int32_t>(ends), write<bool>(decisive));
  });
  return decisive;
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define("project(" SCENE_SCHEMA
           ", Tensor? awake=None) -> (Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, Tensor radii)",
           TORCH_BOX(&project_op));
  m.define("project_binned(" SCENE_SCHEMA
           ", bool train) -> (Tensor splats, Tensor depths, Tensor tile_counts, Tensor radii, Tensor instances, "
           "Tensor ranges, Tensor splat_slots, Tensor slots)",
           TORCH_BOX(&project_binned_op));
  m.define(
      "bin(Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, int height, int width, bool train) -> "
      "(Tensor instances, Tensor ranges, Tensor splat_slots, Tensor slots)",
      TORCH_BOX(&bin_op));
  m.define(
      "blend(Tensor splats, Tensor instances, Tensor ranges, Tensor background, int height, int width, "
      "bool inverse_depth, bool train) -> (Tensor color, Tensor transmittance, Tensor inverse_depth, Tensor last, "
      "Tensor layers)",
      TORCH_BOX(&blend_op));
  m.define(
      "rasterize(Tensor means2d, " SCENE_SCHEMA
      ", Tensor background, bool inverse_depth, bool train, bool absolute=False, Tensor? awake=None, Tensor? "
      "camera=None) -> (Tensor color, "
      "Tensor transmittance, Tensor inverse_depth, Tensor radii, Tensor splats, Tensor tile_counts, Tensor instances, "
      "Tensor ranges, Tensor splat_slots, Tensor slots, Tensor last, Tensor layers)",
      TORCH_BOX(&rasterize_op));
  m.define("decisive(Tensor splats, Tensor instances, Tensor ranges, Tensor last, float[] lens=[]) -> Tensor",
           TORCH_BOX(&decisive_op));
}

}  // namespace gs::ops
