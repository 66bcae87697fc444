// Binning in one of two ways with the same bytes. Lists: the splats of each tile are counted, put into the tile's list,
// and sorted there. Sorting: all splats are sorted by depth, and all instances by tile.
//
// A block of the first way takes neighbouring rows, and counts in its own memory how often they reach each tile. That
// is fast if few blocks reach a tile, as with rows in Morton order. If neighbouring rows lie scattered over the image,
// almost every block reaches almost every tile, and instances are written one by one all over memory. Sorting takes the
// same time for any order of rows, but more launches, and a sort of all rows. So it is taken if a survey finds many
// instances of a row where rows are scattered or the image has many tiles (survey.cuh). Small scenes are not surveyed,
// and neither are those of a host that runs ahead: the host has to know the way before it launches, so the survey would
// make it wait.
#include <cuda_runtime.h>

#include <algorithm>
#include <optional>

#include "backend.h"
#include "cuda/queue/ahead.cuh"
#include "cuda/queue/host_numbers.cuh"
#include "make_records.cuh"
#include "math/slots.h"
#include "sorted_lists.cuh"
#include "survey.cuh"
#include "tile_lists.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int64_t kLeastShare = 2 * kListThreads, kMostShares = 1024;  // shares of the splats, a block for each
constexpr int64_t kMostPlaces = 1 << 24;                               // 64 MiB; images of many tiles get fewer shares
constexpr unsigned kMostBlocks = 8192;

// made: records to release once they have been read, or null. seen: the totals, if the host knows them.
void make_lists(const Queue& queue, int64_t count, const Projected<float>& in, const TileRecord* made, Image image,
                const BinMemory& memory, const std::optional<Survey>& seen) {
  const cudaStream_t stream = stream_of(queue);
  const int64_t tiles = tiles_of(image);
  const int64_t most = std::clamp<int64_t>(kMostPlaces / tiles, 1, kMostShares);
  const int64_t splats = std::max<int64_t>(kLeastShare, (count / most / kListThreads + 1) * kListThreads);
  const unsigned shares = unsigned(count / splats) + 1;  // the last has the slots behind all splats
  int32_t *numbers = queue.array<int32_t>(2 * tiles + 2), *begins = queue.array<int32_t>(tiles + 1);
  const ListCounts counts{numbers,
                          numbers + tiles,
                          numbers + 2 * tiles,
                          numbers + 2 * tiles + 1,
                          queue.array<int32_t>(count),
                          queue.array<int32_t>(shares * tiles)};
  int64_t *of_shares = queue.array<int64_t>(shares), *totals = queue.array<int64_t>(2);
  GS_CUDA_CHECK(cudaMemsetAsync(numbers, 0, (2 * tiles + 2) * sizeof *numbers, stream));
  launch(queue, "count", count_kernel, shares, kListThreads, count, splats, in, image, counts, of_shares);
  // Images of many tiles have many splats without a mask.
  const unsigned large_blocks = std::clamp<unsigned>(unsigned(tiles) / 16, 256, 2048);
  const auto count_large = by_rays(in.rays, [](auto rays) { return count_large_kernel<rays>; });
  launch(queue, "count_large", count_large, large_blocks, kListThreads, in, image, counts);
  launch(queue, "lay_out", lay_out_kernel, 1, kLayThreads, tiles, counts, begins, shares, of_shares, totals,
         memory.ahead ? *memory.ahead : Ahead{});
  Room room;
  if (memory.ahead) {
    room = memory.ahead->room;
  } else if (seen) {
    room = {seen->instances, seen->slots, 0, 0};
  } else {
    const HostNumbers<int64_t> needed(queue, totals, 2);
    room = {needed.wait()[0], needed.wait()[1], 0, 0};
  }
  const Binned out = memory.take(memory.context, room.instances, memory.slots ? room.slots : 0);
  const unsigned further = unsigned(room.instances / kPiece), pieces = further + unsigned(tiles);
  const ListWork work{begins, queue.array<uint64_t>(room.instances), counts.further, queue.array<int2>(further)};
  const auto fill = by_rays(in.rays, [](auto rays) { return fill_kernel<rays>; });
  launch(queue, "fill", fill, shares + large_blocks, kListThreads, count, splats, shares, in, image, counts, of_shares,
         memory.slots, work);
  queue.release(queue.context, counts.large), queue.release(queue.context, counts.places);
  if (made) queue.release(queue.context, made);
  const unsigned blocks = std::min(pieces, kMostBlocks);
  launch(queue, "sort", sort_kernel, blocks, kListThreads, work, further, pieces, out);
  if (further) launch(queue, "merge", merge_kernel, blocks, kListThreads, work, further, pieces, out.instances);
}

}  // namespace

template <>
void bin<float>(const Queue& queue, int64_t count, const Projected<float>& given, Image image,
                const BinMemory& memory) {
  Projected<float> in = given;
  TileRecord* made = nullptr;
  if (count && !in.records && has_records(image)) in.records = made = make_records(queue, count, in, image);
  std::optional<Survey> seen;
  if (!memory.ahead && in.records && survey_pays(count, tiles_of(image))) seen = survey(queue, count, in);
  if (seen && sorting_pays(*seen, count, tiles_of(image)))
    sort_lists(queue, count, in, made, image, memory, *seen);
  else
    make_lists(queue, count, in, made, image, memory, seen);
}

}  // namespace cuda
}  // namespace gs
