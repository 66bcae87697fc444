// The ops that choose which Gaussians' splats each process gets.
#include <cstdint>
#include <limits>
#include <tuple>

#include "backward.h"

namespace gs::ops {

namespace {

// Owns the tensors that a gs::RecordInput points into.
class Reach {
 public:
  Reach(const Tensor& rects, const Tensor& tile_counts, const Tensor& limits) {
    check_given(rects, "rects");
    const Device device = rects.device();
    check_tensor(rects, "rects", ScalarType::Int, device, {-1, 4});
    check_counts(tile_counts, rects.size(0), device);
    check_tensor(limits, "limits", ScalarType::Int, device, {2, -1});
    GS_CHECK(limits.size(1) <= std::numeric_limits<int32_t>::max(), "limits are of too many bands");
    rects_ = packed(rects), counts_ = packed(tile_counts), limits_ = packed(limits);
  }
  gs::RecordInput input() const {
    return {rects_.size(0), int(limits_.size(1)), read<int32_t>(rects_), read<int32_t>(counts_),
            read<int32_t>(limits_)};
  }
  const Tensor& like() const { return rects_; }
  Shape shape() const { return {limits_.size(1) + 1, gs::record_blocks(rects_.size(0))}; }

 private:
  Tensor rects_, counts_, limits_;
};

// How many Gaussians of each block reach each band, and last in how many bands they are.
Tensor count_records_op(const Tensor& rects, const Tensor& tile_counts, const Tensor& limits) {
  const Reach reach(rects, tile_counts, limits);
  Tensor counts = empty<int32_t>(reach.shape(), reach.like());
#ifdef GS_CUDA
  if (rects.is_cuda()) {
    gs::TorchQueue queue(rects.device());
    gs::cuda::count_records(queue.queue(), reach.input(), write<int32_t>(counts));
    return counts;
  }
#endif
  gs::count_records(gs::torch_executor(), reach.input(), write<int32_t>(counts));
  return counts;
}

// Only on the CPU, as reading counts from a GPU waits for it.
void check_record_counts(const Tensor& counts) {
  if (!counts.is_cpu()) return;
  const int32_t* of = read<int32_t>(counts);
  const int64_t by_band = (counts.size(0) - 1) * counts.size(1), all = counts.numel();
  int64_t sums[2] = {0, 0};
  for (int64_t k = 0; k < all; ++k) {
    GS_CHECK_VALUE(of[k] >= 0, "counts must be 0 or more, got ", of[k]);
    sums[k >= by_band] += of[k];
  }
  GS_CHECK_VALUE(sums[0] == sums[1], "counts add up to ", sums[0], " records by band, and to ", sums[1],
                 " of all bands");
}

// The Gaussian of each record, ascending for each band, band after band; and the record's number by Gaussian, then by
// band. counts: of count_records. room: of the lists, from which more records are left out. On a GPU wrong counts are
// not refused; the lists stay undefined then.
std::tuple<Tensor, Tensor> list_records_op(const Tensor& rects, const Tensor& tile_counts, const Tensor& limits,
                                           const Tensor& counts, int64_t room) {
  const Reach reach(rects, tile_counts, limits);
  check_tensor(counts, "counts", ScalarType::Int, rects.device(), reach.shape());
  GS_CHECK(room >= 0 && room <= std::numeric_limits<int32_t>::max(), "a room of ", room, " is not from 0 to 2^31 - 1");
  const Tensor given = packed(counts);
  check_record_counts(given);
  Tensor gaussians = empty<int64_t>({room}, rects), places = empty<int32_t>({room}, rects);
  const gs::RecordLists to{room, write<int64_t>(gaussians), write<int32_t>(places)};
#ifdef GS_CUDA
  if (rects.is_cuda()) {
    gs::TorchQueue queue(rects.device());
    gs::cuda::list_records(queue.queue(), reach.input(), read<int32_t>(given), to);
    return {gaussians, places};
  }
#endif
  gs::list_records(gs::torch_executor(), reach.input(), read<int32_t>(given), to);
  return {gaussians, places};
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define("count_records(Tensor rects, Tensor tile_counts, Tensor limits) -> Tensor", TORCH_BOX(&count_records_op));
  m.define(
      "list_records(Tensor rects, Tensor tile_counts, Tensor limits, Tensor counts, int room) -> "
      "(Tensor gaussians, Tensor places)",
      TORCH_BOX(&list_records_op));
}

}  // namespace gs::ops
