#pragma once
// The forward's plan in images of few tiles: which lists several blocks share, and in which order chunks are served.
// The image does not depend on it.
#include "math/layers.h"
#include "schedule.cuh"

namespace gs {
namespace cuda {

// A list is shared out, a block to each chunk, if it is longer than this and than a kShares-th of all instances. A
// shorter one costs less in one block, which ends with the list's last open pixel, and does not outlast the others.
constexpr int32_t kAlwaysWhole = 512;
constexpr int64_t kShares = 400;

// Chunks that lie in front of others of their list are served first: then the blocks of those behind may find the
// picture opaque before they start, and no block waits for one that is served later. Whole lists fill the time until
// the first chunks are done, the longest first. Chunks come by their depth in the list, those beyond the kLevels-th
// list by list.
struct FrontFirst {
  static constexpr int kLevels = 62, kClasses = kLengthClasses + kLevels + 2;
  const int64_t* ranges;
  int tiles;

  __device__ CutList list(int tile) const {
    const int64_t length = ranges[tile + 1] - ranges[tile];
    const bool shared = length > kAlwaysWhole && length > ranges[tiles] / kShares;
    return {int32_t(length), shared ? kLayerChunk : kWhole};
  }

  template <class Run>
  __device__ void runs(const CutList& list, const Run& run) const {
    const int32_t full = full_chunks(list.length, list.size);
    if (!full) {
      run(1 + length_class(list.length), 0, 1);
    } else {
      run(0, 0, 1);
      for (int32_t c = 1; c <= full && c <= kLevels; ++c) run(kLengthClasses + c, c, 1);
      if (full > kLevels) run(kClasses - 1, kLevels + 1, full - kLevels);
    }
  }
};

// The order of an image's chunks. instances: the sum of all lists' lengths, or more. Also sets `count` numbers at
// `zeros` to 0.
inline Schedule front_first(const Queue& queue, int64_t tiles, const int64_t* ranges, int64_t instances, int32_t* zeros,
                            int64_t count) {
  const int64_t chunks = instances / kLayerChunk, blocks = tiles + chunks;
  Chunk* order = queue.array<Chunk>(blocks);
  launch(queue, "order_chunks", order_chunks_kernel<FrontFirst>, 1, kOrderThreads, int(tiles),
         FrontFirst{ranges, int(tiles)}, int(blocks), order, zeros, count);
  return {order, unsigned(blocks), unsigned(chunks), kLayerChunk};
}

}  // namespace cuda
}  // namespace gs
