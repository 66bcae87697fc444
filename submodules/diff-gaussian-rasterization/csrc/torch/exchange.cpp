// The ops of what processes exchange: splats packed into rows of words, and gradient rows added up and in another
// order.

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

using gs::baseline::kAbsoluteValues, gs::baseline::kGradientValues, gs::baseline::kSplatValues;

// Words of 32 bits of a value. float64 is packed on the CPU alone.
int words_of_value(const Tensor& values) {
  GS_CHECK(values.is_cpu() || has_dtype(values, ScalarType::Float), kFloatAlone);
  return has_dtype(values, ScalarType::Float) ? 1 : 2;
}

const int32_t* words(const Tensor& t) { return static_cast<const int32_t*>(t.const_data_ptr()); }
int32_t* words_to_write(const Tensor& t) { return static_cast<int32_t*>(t.mutable_data_ptr()); }

// Runs a backend's function on the device of the tensor `like`, as GS_RUN does one of a precision.
#ifdef GS_CUDA
#define GS_RUN_WORDS(like, fn, in)         \
  if ((like).is_cuda()) {                  \
    gs::TorchQueue queue((like).device()); \
    gs::cuda::fn(queue.queue(), in);       \
  } else {                                 \
    gs::fn(gs::torch_executor(), in);      \
  }
#else
#define GS_RUN_WORDS(like, fn, in) gs::fn(gs::torch_executor(), in)
#endif

// Only on the CPU, as reading indices from a GPU waits for it. There they are the caller's concern.
void check_indices(const Tensor& gaussians, int64_t count) {
  if (!gaussians.is_cpu()) return;
  const int64_t* indices = read<int64_t>(gaussians);
  for (int64_t i = 0; i < gaussians.size(0); ++i)
    GS_CHECK_VALUE(indices[i] >= 0 && indices[i] < count, "gaussians must be from 0 to ", count - 1, ", got ",
                   indices[i]);
}

// Packs some Gaussians' splats into rows, which may be a part of a larger tensor.
void pack_splats_op(Tensor& packed_rows, const Tensor& splats, const Tensor& depths, const Tensor& rects,
                    const Tensor& tile_counts, const Tensor& gaussians) {
  check_projected(splats, depths, rects, tile_counts);
  const Device device = splats.device();
  check_tensor(gaussians, "gaussians", ScalarType::Long, device, {-1});
  const int wide = words_of_value(splats);
  check_tensor(packed_rows, "packed", ScalarType::Int, device, {gaussians.size(0), gs::packed_words(wide)});
  GS_CHECK_VALUE(packed_rows.is_contiguous(), "packed must be contiguous");
  const auto begin = reinterpret_cast<uintptr_t>(packed_rows.const_data_ptr());
  GS_CHECK_VALUE(wide > 1 || begin % 16 == 0, "packed must begin at a multiple of 16 bytes");
  const Tensor values = aligned(splats, 2), at = packed(depths), boxes = aligned(rects, 2);
  const Tensor counts = packed(tile_counts);
  const Tensor indices = packed(gaussians);
  check_indices(indices, splats.size(0));
  const gs::PackInput in{indices.size(0), wide,          read<int64_t>(indices), words(values),
                         words(at),       words(counts), words(boxes),           write<int32_t>(packed_rows)};
  GS_RUN_WORDS(splats, pack_splats, in);
}

// The rest of the way. like: has the dtype of the splats that were packed.
std::tuple<Tensor, Tensor, Tensor, Tensor> unpack_splats_op(const Tensor& packed_rows, const Tensor& like) {
  check_given(like, "like");
  GS_CHECK_TYPE(is_floating(like.scalar_type()), "like must be float32 or float64, got ", like.scalar_type());
  const int wide = words_of_value(like);
  check_tensor(packed_rows, "packed", ScalarType::Int, like.device(), {-1, gs::packed_words(wide)});
  const Tensor rows = aligned(packed_rows, 4);
  const int64_t n = rows.size(0);
  Tensor splats = empty({n, kSplatValues}, like), depths = empty({n}, like);
  Tensor rects = empty<int32_t>({n, 4}, like), tile_counts = empty<int32_t>({n}, like);
  const gs::UnpackInput in{n,
                           wide,
                           read<int32_t>(rows),
                           words_to_write(splats),
                           words_to_write(depths),
                           write<int32_t>(tile_counts),
                           write<int32_t>(rects)};
  GS_RUN_WORDS(like, unpack_splats, in);
  return {splats, depths, rects, tile_counts};
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
  GS_CHECK(room >= 0 && room <= std::numeric_limits<int32_t>::max(), "a room of ", room, " is not from 0 to 2^31 - 1");
  words_of_value(rows);
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

// The sums of parts of the counts, of `sizes` numbers each, one after the other.
Tensor sum_parts_op(const Tensor& counts, const Shape& sizes) {
  check_given(counts, "counts");
  check_tensor(counts, "counts", ScalarType::Int, counts.device(), {-1});
  int64_t all = 0;
  for (const int64_t size : sizes) {
    GS_CHECK_VALUE(size >= 0, "sizes must be 0 or more, got ", size);
    all += size;
  }
  GS_CHECK_VALUE(all == counts.size(0), "sizes add up to ", all, ", but there are ", counts.size(0), " counts");
  const Tensor given = packed(counts);
  Tensor sums = empty<int64_t>({int64_t(sizes.size())}, counts);
#ifdef GS_CUDA
  if (counts.is_cuda()) {
    gs::TorchQueue queue(counts.device());
    gs::cuda::sum_parts(queue.queue(), read<int32_t>(given), sizes.data(), sizes.size(), write<int64_t>(sums));
    return sums;
  }
#endif
  gs::sum_parts(read<int32_t>(given), sizes.data(), sizes.size(), write<int64_t>(sums));
  return sums;
}

// Whether the runs have all rows, and each a place of its own; only on the CPU.
void check_runs(const Tensor& counts, const Tensor& places, int64_t rows) {
  if (!counts.is_cpu()) return;
  const int32_t *lengths = read<int32_t>(counts), *order = read<int32_t>(places);
  const int64_t n = counts.size(0);
  std::vector<bool> taken(n);
  int64_t sum = 0;
  for (int64_t i = 0; i < n; ++i) {
    GS_CHECK_VALUE(lengths[i] >= 0, "counts must be 0 or more, got ", lengths[i], " of run ", i);
    GS_CHECK_VALUE(order[i] >= 0 && order[i] < n && !taken[order[i]], "places must be the numbers from 0 to ", n - 1,
                   " in any order, got ", order[i], " of run ", i);
    sum += lengths[i], taken[order[i]] = true;
  }
  GS_CHECK_VALUE(sum == rows, "counts add up to ", sum, ", but there are ", rows, " rows");
}

// Gradient rows in another order of their runs. On a GPU bad counts and places are not refused; rows without a run of
// their own stay undefined then.
Tensor move_runs_op(const Tensor& rows, const Tensor& counts, const Tensor& places) {
  check_gradient_rows(rows);
  check_tensor(counts, "counts", ScalarType::Int, rows.device(), {-1});
  check_tensor(places, "places", ScalarType::Int, rows.device(), {counts.size(0)});
  const int wide = words_of_value(rows);
  const Tensor from = aligned(rows, 2), lengths = packed(counts), order = packed(places);
  check_runs(lengths, order, rows.size(0));
  Tensor to = empty(rows.sizes(), rows);
  const gs::MoveInput in{lengths.size(0),      from.size(0), int(wide * from.size(1)), read<int32_t>(lengths),
                         read<int32_t>(order), words(from),  words_to_write(to)};
  GS_RUN_WORDS(rows, move_runs, in);
  return to;
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "pack_splats_(Tensor(a!) packed, Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts, "
      "Tensor gaussians) -> ()",
      TORCH_BOX(&pack_splats_op));
  m.define(
      "unpack_splats(Tensor packed, Tensor like) -> (Tensor splats, Tensor depths, Tensor rects, Tensor tile_counts)",
      TORCH_BOX(&unpack_splats_op));
  m.define("sum_runs(Tensor rows, Tensor counts, Tensor kept, int room) -> Tensor", TORCH_BOX(&sum_runs_op));
  m.define("sum_parts(Tensor counts, int[] sizes) -> Tensor", TORCH_BOX(&sum_parts_op));
  m.define("move_runs(Tensor rows, Tensor counts, Tensor places) -> Tensor", TORCH_BOX(&move_runs_op));
}

}  // namespace gs::ops
