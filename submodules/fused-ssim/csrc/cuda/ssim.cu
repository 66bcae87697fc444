// L1 and SSIM, and their gradient. The forward leaves the derivative of SSIM by each window's statistics in maps, which
// stay in the L2 cache, and the backward gathers them: a kernel for both would compute the windows around each tile
// twice. A block takes a tile. A last block adds the blocks' sums in order, so the same images give the same bits.
#include <cuda_runtime.h>

#include <stdexcept>

#include "backend.h"
#include "cuda/ssim_backward.h"
#include "cuda/ssim_forward.h"
#include "gs/cuda_launch.h"

namespace gs {
namespace {

using namespace GS_ISA;

struct BlockSums {
  double l1, unlike;
};

// The sum over a warp in a fixed tree; lane 0 gets it.
template <class T>
__device__ T warp_sum(T own) {
  for (int offset = 16; offset > 0; offset /= 2) own += __shfl_down_sync(~0u, own, offset);
  return own;
}

// Sums over the block; thread 0 gets the sum. All threads call this once.
template <int kBlock, class T>
__device__ BlockSums block_sum(T l1, T unlike) {
  __shared__ BlockSums warps[kBlock / 32];
  const BlockSums own{double(warp_sum(l1)), double(warp_sum(unlike))};
  if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = own;
  __syncthreads();
  BlockSums all{};
  if (threadIdx.x == 0)
    for (const BlockSums& warp : warps) {
      all.l1 += warp.l1;
      all.unlike += warp.unlike;
    }
  return all;
}

template <class Source>
__device__ Plane<Source> plane_of(const ImagePair<float>& images, const Tile& tile) {
  const int64_t first = tile.plane * (images.height * images.width);
  return {images.img1 + first, static_cast<const Source*>(images.img2) + first, int(images.height), int(images.width),
          images.clamp};
}

// What the forward does: windows of `windows`, and the sums of those blocks that lie in `band`.
struct Part {
  int windows_begin, windows_end, band_begin, band_end;
  int down;  // blocks of the whole image, one below the other
};

template <class Source, bool kGradient>
__global__ void __launch_bounds__(kColumns, 7)
    l1_ssim_kernel(const int32_t* halted, ImagePair<float> images, Tiles tiles, Part part, Maps maps, Frame frame,
                   BlockSums* sums) {
  if (!begin_work(halted)) return;
  __shared__ ForwardTile shared;
  Tile tile = tile_of(tiles, blockIdx.x);
  const Plane<Source> plane = plane_of<Source>(images, tile);
  const int thread = threadIdx.x, first = tile.row;
  Sums own{};
  const int below = first + tiles.rows, end = below < part.windows_end ? below : part.windows_end;
  if (tile.row < part.windows_begin) tile.row = part.windows_begin;
  for (; tile.row < end; tile.row += kForwardRows) {
    column_stats(shared, tile, plane, thread, own);
    __syncthreads();
    window_rows<kGradient>(shared, tile, frame, maps, thread, own);
    __syncthreads();
  }
  const BlockSums all = block_sum<kColumns>(own.l1, own.unlike);
  if (thread == 0 && first >= part.band_begin && first < part.band_end)
    sums[(int64_t(tile.plane) * part.down + first / tiles.rows) * tiles.across.by + tile.across] = all;
}

constexpr int kSumThreads = 512;

__global__ void __launch_bounds__(kSumThreads) mean_kernel(const int32_t* halted, const BlockSums* sums, int64_t n,
                                                           double l1_count, double ssim_count, L1SsimCuda out) {
  if (!begin_work(halted)) return;
  BlockSums own{};
  for (int64_t i = threadIdx.x; i < n; i += kSumThreads) {
    own.l1 += sums[i].l1;
    own.unlike += sums[i].unlike;
  }
  const BlockSums all = block_sum<kSumThreads>(own.l1, own.unlike);
  if (threadIdx.x == 0) {
    const float l1 = float(all.l1 / l1_count);
    const double unlike = all.unlike / ssim_count;
    *out.l1 = l1;
    if (out.ssim) *out.ssim = float(1 - unlike);
    if (out.loss) *out.loss = out.l1_weight * l1 + out.dssim_weight * float(unlike);
  }
}

void check_size(const ImagePair<float>& images, int64_t tiles) {
  if (images.height > INT32_MAX / 2 || images.width > INT32_MAX / 2)
    throw std::runtime_error("an image has more than 2^30 rows or columns: cut it");
  if (tiles > INT32_MAX) throw std::runtime_error("the images have too many planes for one call: pass fewer");
}

// maps: of these rows.
Maps maps_of(const ImagePair<float>& images, float* maps, RowRange rows) {
  float* const first = maps ? maps - rows.begin * kMapRow : nullptr;
  return {first, int(images.height), int(map_strips(images.width)), int(rows.end - rows.begin)};
}

RowRange band_of(const ImagePair<float>& images, const RowRange* rows) {
  return rows ? *rows : RowRange{0, images.height};
}

constexpr int64_t kManyTiles = 1024;  // enough for every processor of a large GPU to have several at once

// Rows of a block of the forward. Two tiles a block halve what a block costs beside its pixels.
int forward_rows(int64_t planes, int64_t height, int64_t width) {
  const int64_t tiles = Tiles::of(kForwardRows, planes, {0, height}, width).count;
  return tiles < kManyTiles ? kForwardRows : 2 * kForwardRows;
}
static_assert(kBandRows % (2 * kForwardRows) == 0);

struct Counts {
  double l1, ssim;  // pixels, and windows that count
};

Counts counts_of(const ImagePair<float>& images, bool valid) {
  const int64_t rim = valid ? kReach : 0;
  return {double(images.planes) * double(images.height) * double(images.width),
          double(images.planes) * double(images.height - rim) * double(images.width - rim)};
}

void find_means(const L1SsimCuda& args, const BlockSums* sums, const Queue& queue) {
  const auto& images = args.images;
  const Counts counts = counts_of(images, args.valid);
  launch(queue, "mean", mean_kernel, 1, kSumThreads, sums, sum_blocks(images.planes, images.height, images.width),
         counts.l1, counts.ssim, args);
}

template <class Source, bool kGradient>
void l1_ssim(const L1SsimCuda& args, const Queue& queue) {
  const auto& images = args.images;
  const int rows = forward_rows(images.planes, images.height, images.width);
  check_size(images, Tiles::of(kForwardRows, images.planes, {0, images.height}, images.width).count);
  const RowRange band = band_of(images, args.rows), windows = map_rows(band, images.height);
  const Tiles tiles = Tiles::of(rows, images.planes, windows, images.width);
  const Part part{int(windows.begin), int(windows.end), int(band.begin), int(band.end),
                  int((images.height + rows - 1) / rows)};
  const Counts counts = counts_of(images, args.valid);
  const Frame frame{int(images.width), args.valid ? kRadius : 0, float(1 / counts.ssim)};
  BlockSums* sums = args.rows ? reinterpret_cast<BlockSums*>(args.sums) : queue.array<BlockSums>(tiles.count);
  if (tiles.count)
    launch(queue, "l1_ssim", l1_ssim_kernel<Source, kGradient>, unsigned(tiles.count), kColumns, images, tiles, part,
           maps_of(images, args.maps, windows), frame, sums);
  if (!args.rows) find_means(args, sums, queue);
}

template <int kRows, class Source>
__global__ void __launch_bounds__(kColumns, 7)
    l1_ssim_vjp_kernel(const int32_t* halted, L1SsimVjpCuda args, Tiles tiles, Maps maps, double mean, bool quads) {
  if (!begin_work(halted)) return;
  __shared__ BackwardTile<kRows> shared;
  const Tile tile = tile_of(tiles, blockIdx.x);
  const Plane<Source> plane = plane_of<Source>(args.images, tile);
  const int thread = threadIdx.x;
  WindowColumn<kRows> windows = load_windows(shared, tile, maps, plane.width, thread);
  __syncthreads();
  gather_down(shared, tile, maps, plane.width, windows, thread);
  __syncthreads();
  const Chain chain{float(double(*args.grad_l1 * args.l1_weight) * mean), *args.grad_ssim * args.ssim_weight,
                    args.grad_img1 + (plane.img1 - args.images.img1), quads};
  gather_across(shared, tile, plane, chain, thread);
}

bool is_multiple(const void* pointer, size_t bytes) { return reinterpret_cast<uintptr_t>(pointer) % bytes == 0; }

template <int kRows, class Source>
void l1_ssim_vjp(const L1SsimVjpCuda& args, const Queue& queue) {
  const auto& images = args.images;
  const RowRange band = band_of(images, args.rows);
  const Tiles tiles = Tiles::of(kRows, images.planes, band, images.width);
  check_size(images, tiles.count);
  if (!tiles.count) return;
  const bool quads = images.width % 4 == 0 && is_multiple(images.img1, sizeof(Four)) &&
                     is_multiple(images.img2, sizeof(Quad<Source>)) && is_multiple(args.grad_img1, sizeof(Four));
  const double mean = 1 / double(images.planes * images.height * images.width);
  const Maps maps = maps_of(images, const_cast<float*>(args.maps), map_rows(band, images.height));
  launch(queue, "l1_ssim_vjp", l1_ssim_vjp_kernel<kRows, Source>, unsigned(tiles.count), kColumns, args, tiles, maps,
         mean, quads);
}

// Lower tiles read more rows for each of theirs, but a small image needs them to fill a large GPU. A compiler may fuse
// products otherwise for them, so a band takes those of its image.
template <class Source>
void l1_ssim_vjp(const L1SsimVjpCuda& args, const Queue& queue) {
  const auto& images = args.images;
  const int64_t tiles = Tiles::of(16, images.planes, {0, images.height}, images.width).count;
  tiles < kManyTiles / 2 ? l1_ssim_vjp<8, Source>(args, queue) : l1_ssim_vjp<16, Source>(args, queue);
}

}  // namespace

int64_t sum_blocks(int64_t planes, int64_t height, int64_t width) {
  return Tiles::of(forward_rows(planes, height, width), planes, {0, height}, width).count;
}

void l1_ssim_means_cuda(const L1SsimCuda& args, const Queue& queue) {
  find_means(args, reinterpret_cast<const BlockSums*>(args.sums), queue);
}

void l1_ssim_cuda(const L1SsimCuda& args, const Queue& queue) {
  if (args.images.img2_is_bytes)
    args.maps ? l1_ssim<uint8_t, true>(args, queue) : l1_ssim<uint8_t, false>(args, queue);
  else
    args.maps ? l1_ssim<float, true>(args, queue) : l1_ssim<float, false>(args, queue);
}

void l1_ssim_vjp_cuda(const L1SsimVjpCuda& args, const Queue& queue) {
  args.images.img2_is_bytes ? l1_ssim_vjp<uint8_t>(args, queue) : l1_ssim_vjp<float>(args, queue);
}

}  // namespace gs
