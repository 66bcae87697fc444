// The ops of what processes exchange: which Gaussians' splats each of them gets, and gradient rows added up.
#include <cstdint>
#include <limits>
#include <tuple>
#include <type_traits>

#include "backward.h"
#include "math/absolute.h"
#include "math/splat.h"

namespace gs::ops {

namespace {

using gs::baseline::kAbsoluteValues, gs::baseline::kGradientValues;

void check_room(int64_t room) {
  GS_CHECK(room >= 0 && room <= std::numeric_limits<int32_t>::max(), "a room of ", room, " is not from 0 to 2^31 - 1");
}

// How many Gaussians of each block of gs::kRecordBlock reach each band, and last in how many bands they are; the
// Gaussian of each record, ascending for each band, band after band; and the record's number by Gaussian, then by band.
// limits: rows of tiles where each band begins, and where it ends. room: of the lists, from which more records are left
// out.
std::tuple<Tensor, Tensor, Tensor> list_records_op(const Tensor& rects, const Tensor& tile_counts, const Tensor& limits,
                                                   int64_t room) {
  check_given(rects, "rects");
  const Device device = rects.device();
  check_tensor(rects, "rects", ScalarType::Int, device, {-1, 4});
  check_counts(tile_counts, rects.size(0), device);
  check_tensor(limits, "limits", ScalarType::Int, device, {2, -1});
  GS_CHECK(limits.size(1) <= std::numeric_limits<int32_t>::max(), "limits are of too many bands");
  check_room(room);
  const Tensor boxes = packed(rects), tiles = packed(tile_counts), bands = packed(limits);
  Tensor counts = empty<int32_t>({bands.size(1) + 1, gs::record_blocks(boxes.size(0))}, rects);
  Tensor gaussians = empty<int64_t>({room}, rects), places = empty<int32_t>({room}, rects);
  const gs::RecordInput in{boxes.size(0), int(bands.size(1)), read<int32_t>(boxes), read<int32_t>(tiles),
                           read<int32_t>(bands)};
  const gs::RecordLists to{room, write<int32_t>(counts), write<int64_t>(gaussians), write<int32_t>(places)};
  run_at(rects, [&](const auto& where) { gs::list_records(where, in, to); });
  return {counts, gaussians, places};
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
// left out. room: rows of the result, of which only those that `kept` adds up to are defined. On a GPU bad numbers are
// not refused; rows that they would give stay undefined then.
Tensor sum_runs_op(const Tensor& rows, const Tensor& counts, const Tensor& kept, int64_t room) {
  check_gradient_rows(rows);
  check_tensor(counts, "counts", ScalarType::Int, rows.device(), {-1});
  check_tensor(kept, "kept", ScalarType::Int, rows.device(), {counts.size(0)});
  check_room(room);
  GS_CHECK(rows.is_cpu() || has_dtype(rows, ScalarType::Float), kFloatAlone);
  const Tensor from = aligned(rows, 2), lengths = packed(counts), left = packed(kept);
  check_sums(lengths, left, rows.size(0), room);
  Tensor to = empty({room, rows.size(1)}, rows);
  with_scalar(rows.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    const gs::SumInput<T> in{lengths.size(0),        from.size(0),        room,          int(from.size(1)),
                             read<int32_t>(lengths), read<int32_t>(left), read<T>(from), write<T>(to)};
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
      "list_records(Tensor rects, Tensor tile_counts, Tensor limits, int room) -> "
      "(Tensor counts, Tensor gaussians, Tensor places)",
      TORCH_BOX(&list_records_op));
  m.define("sum_runs(Tensor rows, Tensor counts, Tensor kept, int room) -> Tensor", TORCH_BOX(&sum_runs_op));
}

}  // namespace gs::ops
