// The ops of what processes exchange: which Gaussians' splats each of them gets, and gradient rows added up.
#include <cstdint>
#include <limits>
#include <tuple>
#include <type_traits>
#include <vector>

#include "backward.h"
#include "math/absolute.h"
#include "math/splat.h"

namespace gs::ops {

namespace {

using gs::baseline::kAbsoluteValues, gs::baseline::kGradientValues;

void check_room(int64_t room) {
  GS_CHECK(room >= 0 && room <= std::numeric_limits<int32_t>::max(), "a room of ", room, " is not from 0 to 2^31 - 1");
}

using Records = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// Without `counts`: how many Gaussians of each block of gs::kRecordBlock reach each band, and last in how many bands
// they are, and nothing else. With them, and a column behind: the records (gs::RecordLists). limits: rows of
// tiles where each band begins, and where it ends. room: for records; more are left out. Counts of another scene are
// not refused; records stay undefined then.
Records list_records_op(const Tensor& rects, const Tensor& tile_counts, const Tensor& limits, const MaybeTensor& counts,
                        const MaybeTensor& splats, const MaybeTensor& depths, int64_t room) {
  check_given(rects, "rects");
  const Device device = rects.device();
  check_tensor(rects, "rects", ScalarType::Int, device, {-1, 4});
  check_counts(tile_counts, rects.size(0), device);
  check_tensor(limits, "limits", ScalarType::Int, device, {2, -1});
  GS_CHECK(limits.size(1) <= std::numeric_limits<int32_t>::max(), "limits are of too many bands");
  check_room(room);
  const Tensor boxes = aligned(rects, 4), tiles = packed(tile_counts), bands = packed(limits);
  const int64_t count = boxes.size(0), blocks = gs::record_blocks(count);
  const gs::RecordInput in{count, int(bands.size(1)), read<int32_t>(boxes), read<int32_t>(tiles), read<int32_t>(bands)};
  const auto nothing = [&] { return empty<int32_t>({0}, rects); };
  GS_CHECK_TYPE(bool(given(counts)) == bool(given(splats)) && bool(given(counts)) == bool(given(depths)),
                "counts, splats and depths must be given together");
  if (!given(counts)) {
    Tensor found = empty<int32_t>({bands.size(1) + 1, blocks}, rects);
    run_at(rects, [&](const auto& where) { gs::count_records(where, in, write<int32_t>(found)); });
    return {found, nothing(), nothing(), nothing(), nothing(), nothing(), nothing()};
  }
  check_tensor(*counts, "counts", ScalarType::Int, device, {bands.size(1) + 1, blocks + 1});
  check_staged(*splats);
  const ScalarType type = splats->scalar_type();
  check_tensor(*splats, "splats", type, device, {count, splats->size(1)});
  check_tensor(*depths, "depths", type, device, {count});
  GS_CHECK(rects.is_cpu() || type == ScalarType::Float, kFloatAlone);
  const Tensor numbers = packed(*counts), rows = aligned(*splats, 2), far = packed(*depths);
  Tensor gaussians = empty<int64_t>({room}, rects), places = empty<int32_t>({room}, rects);
  Tensor new_splats = empty({room, rows.size(1)}, rows), new_depths = empty({room}, rows);
  Tensor new_rects = empty<int32_t>({room, 4}, rects), new_tiles = empty<int32_t>({room}, rects);
  with_scalar(type, [&](auto zero) {
    using T = decltype(zero);
    const gs::RecordLists<T> to{room,
                                int(rows.size(1)),
                                read<int32_t>(numbers),
                                read<T>(rows),
                                read<T>(far),
                                write<int64_t>(gaussians),
                                write<int32_t>(places),
                                write<T>(new_splats),
                                write<T>(new_depths),
                                write<int32_t>(new_rects),
                                write<int32_t>(new_tiles)};
    if (!rects.is_cuda()) return gs::list_records(gs::torch_executor(), in, to);
#ifdef GS_CUDA
    if constexpr (std::is_same_v<T, float>) {
      gs::TorchQueue queue(device);
      gs::cuda::list_records(queue.queue(), in, to);
    }
#endif
  });
  return {nothing(), gaussians, places, new_splats, new_depths, new_rects, new_tiles};
}

// Values of a gradient row, with or without those of absolute gradients.
void check_gradient_rows(const Tensor& rows) {
  check_given(rows, "rows");
  GS_CHECK_TYPE(is_floating(rows.scalar_type()), "rows must be float32 or float64, got ", rows.scalar_type());
  GS_CHECK_VALUE(
      rows.dim() == 2 && (rows.size(1) == kGradientValues || rows.size(1) == kGradientValues + kAbsoluteValues),
      "rows must be (R, ", kGradientValues, ") or (R, ", kGradientValues + kAbsoluteValues, "), got ", rows.sizes());
  GS_CHECK(rows.size(0) <= std::numeric_limits<int32_t>::max(), rows.size(0), " rows are more than 2^31 - 1");
}

// Whether `places` are the numbers of all runs, in any order; only on the CPU.
void check_places(const Tensor& places) {
  if (!places.is_cpu()) return;
  const int64_t runs = places.size(0);
  std::vector<bool> taken(runs);
  for (int64_t i = 0; i < runs; ++i) {
    const int64_t place = read<int32_t>(places)[i];
    GS_CHECK_VALUE(place >= 0 && place < runs && !taken[place], "places must be 0 to ", runs - 1, " in any order, got ",
                   place, " of run ", i);
    taken[place] = true;
  }
}

// Whether the runs have all rows, and what is kept of them finds room; only on the CPU.
void check_sums(const Tensor& counts, const Tensor& kept, int64_t rows, int64_t room) {
  if (!counts.is_cpu()) return;
  const int32_t *lengths = read<int32_t>(counts), *left = read<int32_t>(kept);
  int64_t sums[2] = {0, 0};
  for (int64_t i = 0; i < counts.size(0); ++i) {
    GS_CHECK_VALUE(lengths[i] >= 0, "counts must be 0 or more, got ", lengths[i], " of run ", i);
    GS_CHECK_VALUE(left[i] == 0 || left[i] == 1 || left[i] == lengths[i], "kept must be 0, 1 or the run's count, got ",
                   left[i], " of run ", i);
    sums[0] += lengths[i], sums[1] += left[i];
  }
  GS_CHECK_VALUE(sums[0] == rows, "counts add up to ", sums[0], ", but there are ", rows, " rows");
  GS_CHECK_VALUE(sums[1] <= room, "kept adds up to ", sums[1], " rows, for which a room of ", room, " is too small");
}

// Runs of gradient rows of which each is kept, or becomes one row, its sum, which is of zeros if it has no rows; or is
// left out. room: rows of the result, of which only those that `kept` adds up to are defined. places: the number of
// each run in the order of the result, if that is another. On a GPU bad numbers are not refused; rows that they would
// give stay undefined then.
Tensor sum_runs_op(const Tensor& rows, const Tensor& counts, const Tensor& kept, int64_t room,
                   const MaybeTensor& places) {
  check_gradient_rows(rows);
  check_tensor(counts, "counts", ScalarType::Int, rows.device(), {-1});
  check_tensor(kept, "kept", ScalarType::Int, rows.device(), {counts.size(0)});
  check_room(room);
  GS_CHECK(rows.is_cpu() || has_dtype(rows, ScalarType::Float), kFloatAlone);
  const Tensor from = aligned(rows, 2), lengths = packed(counts), left = packed(kept);
  check_sums(lengths, left, rows.size(0), room);
  Tensor order;
  if (given(places)) {
    check_tensor(*places, "places", ScalarType::Int, rows.device(), {counts.size(0)});
    check_places(order = packed(*places));
  }
  Tensor to = empty({room, rows.size(1)}, rows);
  with_scalar(rows.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::SumInput<T> in{
        lengths.size(0),   from.size(0),           room,
        int(from.size(1)), read<int32_t>(lengths), read<int32_t>(left),
        read<T>(from),     write<T>(to),           order.defined() ? read<int32_t>(order) : nullptr};
    if (!rows.is_cuda()) return gs::sum_runs(gs::torch_executor(), in);
#ifdef GS_CUDA
    if constexpr (std::is_same_v<T, float>) {
      gs::TorchQueue queue(rows.device());
      gs::cuda::sum_runs(queue.queue(), in);
    }
#endif
  });
  return to;
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "list_records(Tensor rects, Tensor tile_counts, Tensor limits, Tensor? counts=None, Tensor? splats=None, "
      "Tensor? depths=None, int room=0) -> (Tensor counts, Tensor gaussians, Tensor places, Tensor splats, "
      "Tensor depths, Tensor rects, Tensor tile_counts)",
      TORCH_BOX(&list_records_op));
  m.define("sum_runs(Tensor rows, Tensor counts, Tensor kept, int room, Tensor? places=None) -> Tensor",
           TORCH_BOX(&sum_runs_op));
}

}  // namespace gs::ops
