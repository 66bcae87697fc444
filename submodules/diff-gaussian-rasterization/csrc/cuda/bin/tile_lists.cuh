#pragma once
// The kernels that make each tile's list. A tile's instances are counted, put into its list in any order, and sorted
// there by depth, then by splat.
#include "each_tile.cuh"

namespace gs {
namespace cuda {

constexpr int kListThreads = 256;
constexpr int kLayThreads = 1024;

// Returns the sum of the values of the block's threads before this one, and the sum of all in `total`.
template <class T>
__device__ inline T sum_before(T value, T& total) {
  __shared__ T of_warps[32];
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, warps = blockDim.x / 32;
  T end = value;
  for (int step = 1; step < 32; step *= 2) {
    const T before = __shfl_up_sync(kWarp, end, step);
    if (lane >= step) end += before;
  }
  if (lane == 31) of_warps[warp] = end;
  __syncthreads();
  T before = 0;
  total = 0;
  for (int w = 0; w < warps; ++w) {
    if (w < warp) before += of_warps[w];
    total += of_warps[w];
  }
  __syncthreads();
  return before + end - value;
}

// A block takes splats that lie side by side, which mostly reach the same tiles, so it counts in shared memory first:
// atomic operations of many blocks on one word of global memory take turns. It takes kWindow tiles at a time.
constexpr int kWindow = 8192;

// The splats of a block.
struct Share {
  int64_t first, end;
  __device__ Share(int64_t n, int64_t splats) : first(splats * blockIdx.x), end(min(first + splats, n)) {}

  // Where the tiles begin and end that splats with a mask may reach; all tiles, if one window holds them. All threads
  // of the block call this.
  __device__ int2 span(const Projected<float>& in, Image image) const {
    const int tiles = int(tiles_of(image)), columns = tile_count(image.width);
    if (tiles <= kWindow) return make_int2(0, tiles);
    __shared__ int2 all;
    if (threadIdx.x == 0) all = make_int2(tiles, 0);
    __syncthreads();
    int2 own = make_int2(tiles, 0);
    for (int64_t i = first + threadIdx.x; i < end; i += kListThreads) {
      const Reached reached = reached_by(in, int32_t(i));
      if (!reached.mask) continue;
      own.x = min(own.x, reached.rect.y0 * columns + reached.rect.x0);
      own.y = max(own.y, (reached.rect.y1 - 1) * columns + reached.rect.x1);
    }
    atomicMin(&all.x, own.x), atomicMax(&all.y, own.y);
    __syncthreads();
    return all;
  }
};

// What the counting kernels fill in. At first all but `large` and `places` are 0.
struct ListCounts {
  int32_t* masked;    // (tiles) instances of splats that have a mask
  int32_t* unmasked;  // (tiles) instances of splats that reach too many tiles
  int32_t* larges;    // the number of such splats
  int32_t* further;   // the number of ListWork::pieces
  int32_t* large;     // (splats) which they are, in any order
  int32_t* places;    // (shares, tiles) where each share's instances begin among the masked ones
};

// Counts the instances of splats that have a mask, and the slots of each share of the splats, and lists other splats.
__global__ void __launch_bounds__(kListThreads)
    count_kernel(const int32_t* halted, int64_t n, int64_t splats, Projected<float> in, Image image, ListCounts counts,
                 int64_t* of_shares) {
  if (!begin_work(halted)) return;
  __shared__ int32_t table[kWindow];
  const Share share(n, splats);
  const int2 span = share.span(in, image);
  const int64_t tiles = tiles_of(image);
  int64_t slots = 0, total;
  int window = span.x;
  do {
    const int wide = min(span.y - window, kWindow);
    for (int t = threadIdx.x; t < wide; t += kListThreads) table[t] = 0;
    __syncthreads();
    for (int64_t i = share.first + threadIdx.x; i < share.end; i += kListThreads) {
      const Reached reached = reached_by(in, int32_t(i));
      if (window == span.x) {
        slots += slot_count(reached.rect);
        if (reached.count && !reached.mask) counts.large[atomicAdd(counts.larges, 1)] = int32_t(i);
      }
      each_tile(reached, tile_count(image.width), [&](const int (&its)[kTaken]) {
#pragma unroll
        for (const int tile : its)
          if (unsigned(tile - window) < unsigned(wide)) atomicAdd(table + tile - window, 1);
      });
    }
    __syncthreads();
    for (int t = threadIdx.x; t < wide; t += kListThreads)
      if (table[t]) counts.places[tiles * blockIdx.x + window + t] = atomicAdd(counts.masked + window + t, table[t]);
    __syncthreads();
  } while ((window += kWindow) < span.y);
  sum_before(slots, total);
  if (threadIdx.x == 0) of_shares[blockIdx.x] = total;
}

// Calls take(tile, splat) for the tiles of splats without a mask, which the warps of `blocks` blocks share.
template <int kRays, class Take>
__device__ __forceinline__ void each_large(const Projected<float>& in, Image image, const ListCounts& counts,
                                           unsigned block, unsigned blocks, const Take& take) {
  constexpr unsigned kWarps = kListThreads / 32;
  for (int k = int(block * kWarps + threadIdx.x / 32), all = *counts.larges; k < all; k += blocks * kWarps) {
    const int32_t splat = counts.large[k];
    each_tested<kRays>(in, splat, image, threadIdx.x % 32, 32, [&](int tile) { take(tile, splat); });
  }
}

template <int kRays>
__global__ void __launch_bounds__(kListThreads)
    count_large_kernel(const int32_t* halted, Projected<float> in, Image image, ListCounts counts) {
  if (!begin_work(halted)) return;
  each_large<kRays>(in, image, counts, blockIdx.x, gridDim.x,
                    [&](int tile, int32_t) { atomicAdd(counts.unmasked + tile, 1); });
}

constexpr int kLayRun = 4;  // counts of a thread at a time

// Turns counts(i) into their sums before each, in one block. Returns the sum of all.
template <class Counts, class To>
__device__ inline int64_t sums_before(int64_t count, const Counts& counts, To* sums) {
  int64_t before = 0, total;
  for (int64_t from = 0; from < count; from += kLayRun * kLayThreads, before += total) {
    const int64_t first = from + kLayRun * int(threadIdx.x);
    int64_t own[kLayRun], sum = 0;
#pragma unroll
    for (int k = 0; k < kLayRun; ++k) own[k] = first + k < count ? counts(first + k) : 0, sum += own[k];
    sum = before + sum_before(sum, total);
#pragma unroll
    for (int k = 0; k < kLayRun; ++k) {
      if (first + k < count) sums[first + k] = To(sum);
      sum += own[k];
    }
  }
  return before;
}

// Finds where each tile's list and each share's slots begin, and the totals of both. begins: (tiles + 1). ahead: judges
// the totals, if it is one.
__global__ void __launch_bounds__(kLayThreads)
    lay_out_kernel(const int32_t* halted, int64_t tiles, ListCounts counts, int32_t* begins, int64_t shares,
                   int64_t* of_shares, int64_t* totals, Ahead ahead) {
  if (!begin_work(halted)) return;
  const int64_t instances =
      sums_before(tiles, [&](int64_t t) { return int64_t(counts.masked[t]) + counts.unmasked[t]; }, begins);
  const int64_t slots = sums_before(shares, [&](int64_t k) { return of_shares[k]; }, of_shares);
  if (threadIdx.x) return;
  begins[tiles] = int32_t(instances), totals[0] = instances, totals[1] = slots;
  if (ahead.halted) judge_lists(ahead, instances, slots);
}

constexpr int kPieceRun = 8;                      // instances of a thread
constexpr int kPiece = kPieceRun * kListThreads;  // of a list, which a block sorts; pieces are then merged

// What the lists are made of. All pieces of lists but the first of each are listed, in any order.
struct ListWork {
  const int32_t* begins;
  uint64_t* keys;  // depth's bits, which sort as depths do, then the splat
  const int32_t* further;
  int2* pieces;  // (instances / kPiece) the tile, and the piece's number in the list
};

__device__ __forceinline__ uint64_t list_key(const Projected<float>& in, int32_t splat) {
  return uint64_t(__float_as_uint(in.depths[splat])) << 32 | uint32_t(splat);
}

// Puts each splat's instances into the lists, and stores its slots, if they are wanted; those of splat n are behind
// all. Blocks behind those of the shares take splats without a mask.
template <int kRays>
__global__ void __launch_bounds__(kListThreads)
    fill_kernel(const int32_t* halted, int64_t n, int64_t splats, unsigned shares, Projected<float> in, Image image,
                ListCounts counts, const int64_t* of_shares, SplatSlots* slots, ListWork work) {
  if (!begin_work(halted)) return;
  __shared__ int32_t table[kWindow];
  const int64_t tiles = tiles_of(image);
  if (blockIdx.x >= shares) {
    const unsigned block = blockIdx.x - shares, blocks = gridDim.x - shares;
    for (int64_t t = block * kListThreads + threadIdx.x; t < tiles; t += blocks * kListThreads) {
      const int32_t further = (work.begins[t + 1] - work.begins[t] - 1) / kPiece;
      if (further <= 0) continue;
      const int32_t first = atomicAdd(counts.further, further);
      for (int32_t k = 0; k < further; ++k) work.pieces[first + k] = make_int2(int(t), k + 1);
    }
    each_large<kRays>(in, image, counts, block, blocks, [&](int tile, int32_t splat) {
      work.keys[work.begins[tile] + atomicAdd(counts.masked + tile, 1)] = list_key(in, splat);
    });
    return;
  }
  const Share share(n, splats);
  const int2 span = share.span(in, image);
  for (int window = span.x; window < span.y; window += kWindow) {
    const int wide = min(span.y - window, kWindow);
    for (int t = threadIdx.x; t < wide; t += kListThreads)  // where the share has none, any number
      table[t] = work.begins[window + t] + counts.places[tiles * blockIdx.x + window + t];
    __syncthreads();
    for (int64_t i = share.first + threadIdx.x; i < share.end; i += kListThreads) {
      const Reached reached = reached_by(in, int32_t(i));
      if (!reached.mask) continue;
      const uint64_t key = list_key(in, int32_t(i));
      each_tile(reached, tile_count(image.width), [&](const int (&its)[kTaken]) {
#pragma unroll
        for (const int tile : its)
          if (unsigned(tile - window) < unsigned(wide)) work.keys[atomicAdd(table + tile - window, 1)] = key;
      });
    }
    __syncthreads();
  }
  if (!slots) return;
  int64_t before = of_shares[blockIdx.x], total;
  for (int64_t first = share.first; first < share.end || first == n; first += kListThreads, before += total) {
    const int64_t i = first + threadIdx.x;
    const TileRect rect = i < share.end ? reached_by(in, int32_t(i)).rect : TileRect{};
    const int64_t own = before + sum_before(slot_count(rect), total);
    if (i < share.end || i == n) slots[i] = splat_slots(own, rect);
  }
}

// A piece of a list. Those behind the first of their list come first, then those of all tiles.
struct Piece {
  int tile;
  int64_t begin;  // of the list
  int length;     // of the list
  int first;      // of the piece, in the list
  int count;      // 0: no piece

  __device__ Piece(const ListWork& work, unsigned number, unsigned most_further) {
    const bool is_further = number < most_further;
    tile = is_further ? -1 : int(number - most_further), first = count = length = 0, begin = 0;
    if (is_further && int(number) < *work.further) tile = work.pieces[number].x, first = kPiece * work.pieces[number].y;
    if (tile < 0) return;
    begin = work.begins[tile], length = work.begins[tile + 1] - int(begin);
    count = length - first < kPiece ? length - first : kPiece;
  }
};

// The thread's place in a piece, of kPieceRun.
__device__ __forceinline__ int place_of(int run) { return run * kListThreads + int(threadIdx.x); }

// A piece in shared memory, sorted by buckets of like depth.
struct Buckets {
  uint64_t sorted[kPiece];
  int32_t starts[kPiece + 1];
  uint32_t least, most;

  // Turns the counts of `buckets` buckets into where each begins.
  __device__ void lay_out(int buckets) {
    const int own = buckets / kListThreads, first = own * int(threadIdx.x);
    int32_t sum = 0, total;
    for (int b = first; b < first + own; ++b) sum += starts[b];
    sum = sum_before(sum, total);
    for (int b = first; b < first + own; ++b) {
      const int32_t in_bucket = starts[b];
      starts[b] = sum;
      sum += in_bucket;
    }
    if (threadIdx.x == 0) starts[buckets] = total;
    __syncthreads();
  }
};

constexpr int kCompared = 128;  // instances that are not worth buckets
static_assert(kCompared <= kListThreads);

// Sorts a piece: by buckets, and within each by comparing all with all, because almost all buckets have few instances.
// Few instances make one bucket. Calls put(rank, key). All threads call this.
template <class Put>
__device__ __forceinline__ void sort_piece(Buckets& shared, const uint64_t* keys, int count, const Put& put) {
  __syncthreads();
  if (count <= kCompared) {
    const int mine = threadIdx.x;
    if (mine < count) shared.sorted[mine] = keys[mine];
    __syncthreads();
    if (mine >= count) return;
    const uint64_t key = shared.sorted[mine];
    int rank = 0;
    for (int k = 0; k < count; ++k) rank += shared.sorted[k] < key;
    return put(rank, key);
  }
  const int buckets = (count + kListThreads - 1) / kListThreads * kListThreads;
  if (threadIdx.x == 0) shared.least = ~0u, shared.most = 0;
  for (int b = threadIdx.x; b < buckets; b += kListThreads) shared.starts[b] = 0;
  __syncthreads();
  uint64_t key[kPieceRun];
  uint32_t low = ~0u, high = 0;
#pragma unroll
  for (int r = 0; r < kPieceRun; ++r) {
    if (place_of(r) >= count) continue;
    key[r] = keys[place_of(r)];
    const uint32_t depth = uint32_t(key[r] >> 32);
    low = depth < low ? depth : low, high = depth > high ? depth : high;
  }
  low = warp_min(low), high = warp_max(high);
  if (threadIdx.x % 32 == 0) atomicMin(&shared.least, low), atomicMax(&shared.most, high);
  __syncthreads();
  const uint32_t least = shared.least;
  const float scale = float(buckets) / (float(shared.most - least) + 1);
  int32_t bucket[kPieceRun], place[kPieceRun];
#pragma unroll
  for (int r = 0; r < kPieceRun; ++r) {
    if (place_of(r) >= count) continue;
    const int in_order = int(float(uint32_t(key[r] >> 32) - least) * scale);
    bucket[r] = in_order < buckets ? in_order : buckets - 1;
    place[r] = atomicAdd(shared.starts + bucket[r], 1);
  }
  __syncthreads();
  shared.lay_out(buckets);
#pragma unroll
  for (int r = 0; r < kPieceRun; ++r)
    if (place_of(r) < count) shared.sorted[shared.starts[bucket[r]] + place[r]] = key[r];
  __syncthreads();
#pragma unroll
  for (int r = 0; r < kPieceRun; ++r) {
    if (place_of(r) >= count) continue;
    const int begin = shared.starts[bucket[r]], end = shared.starts[bucket[r] + 1];
    int rank = begin;
    for (int k = begin; k < end; ++k) rank += shared.sorted[k] < key[r];
    put(rank, key[r]);
  }
}

// Writes the ranges, and the splats of lists of one piece; the keys of other pieces are sorted in place.
__global__ void __launch_bounds__(kListThreads)
    sort_kernel(const int32_t* halted, ListWork work, unsigned most_further, unsigned pieces, Binned out) {
  if (!begin_work(halted)) return;
  __shared__ Buckets shared;
  for (unsigned number = blockIdx.x; number < pieces; number += gridDim.x) {
    const Piece piece(work, number, most_further);
    if (threadIdx.x == 0 && piece.tile >= 0 && piece.first == 0) {
      if (piece.tile == 0) out.ranges[0] = 0;
      out.ranges[piece.tile + 1] = piece.begin + piece.length;
    }
    if (!piece.count) continue;
    uint64_t* keys = work.keys + piece.begin + piece.first;
    sort_piece(shared, keys, piece.count, [&](int rank, uint64_t key) {
      if (piece.length <= kPiece)
        out.instances[piece.begin + rank] = int32_t(key);
      else
        keys[rank] = key;
    });
  }
}

// Merges the sorted pieces of a list: an instance comes behind those of all pieces that have smaller keys.
__global__ void __launch_bounds__(kListThreads)
    merge_kernel(const int32_t* halted, ListWork work, unsigned most_further, unsigned pieces, int32_t* instances) {
  if (!begin_work(halted) || !*work.further) return;
  for (unsigned number = blockIdx.x; number < pieces; number += gridDim.x) {
    const Piece piece(work, number, most_further);
    if (piece.length <= kPiece) continue;
    const uint64_t* keys = work.keys + piece.begin;
    uint64_t key[kPieceRun];
    int rank[kPieceRun];
#pragma unroll
    for (int r = 0; r < kPieceRun; ++r)
      key[r] = place_of(r) < piece.count ? keys[piece.first + place_of(r)] : 0, rank[r] = place_of(r);
    for (int first = 0; first < piece.length; first += kPiece) {
      if (first == piece.first) continue;
      int smaller[kPieceRun] = {};
      for (int left = piece.length - first < kPiece ? piece.length - first : kPiece; left > 0; left /= 2) {
        const int half = (left + 1) / 2;
#pragma unroll
        for (int r = 0; r < kPieceRun; ++r)
          if (keys[first + smaller[r] + half - 1] < key[r]) smaller[r] += half;
      }
#pragma unroll
      for (int r = 0; r < kPieceRun; ++r) rank[r] += smaller[r];
    }
#pragma unroll
    for (int r = 0; r < kPieceRun; ++r)
      if (place_of(r) < piece.count) instances[piece.begin + rank[r]] = int32_t(key[r]);
  }
}

}  // namespace cuda
}  // namespace gs
