#pragma once
// Makes the records of splats that come with rectangles alone, the same as projection makes.
#include "cuda/project/splat_row.cuh"
#include "cuda/project/tile_record.cuh"
#include "cuda/project/tiles.cuh"

namespace gs {
namespace cuda {

constexpr int kRecordThreads = 128;

// A thread takes a splat; a warp shares the tests of its tiles.
template <int kRays>
__global__ void __launch_bounds__(kRecordThreads)
    make_records_kernel(const int32_t* halted, int64_t n, Projected<float> in, Image image, TileRecord* records) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kRecordThreads + threadIdx.x;
  Reached reached = {};
  SplatOf<float, kRays> shape = {};
  if (i < n) reached = reached_by(in, int32_t(i));
  if (reached.count) shape = load_shape<kRays>(in.splats, i);
  uint64_t mask;
  const int32_t count = warp_count_tiles<true>(shape, reached.rect, image, in.table, mask);
  if (i < n) records[i] = tile_record(reached.rect, count, mask);
}

// in: without records, of an image with has_records.
inline TileRecord* make_records(const Queue& queue, int64_t n, const Projected<float>& in, Image image) {
  TileRecord* records = queue.array<TileRecord>(n);
  const auto kernel = by_rays(in.rays, [](auto rays) { return make_records_kernel<rays>; });
  launch(queue, "make_records", kernel, blocks_for(n, kRecordThreads), kRecordThreads, n, in, image, records);
  return records;
}

}  // namespace cuda
}  // namespace gs
