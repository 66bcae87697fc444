// The table of a lens with rays. A block takes a tile, a thread a pixel.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/queue/queue.cuh"
#include "math/lens_table.h"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

constexpr int kThreads = kTile * kTile;

__device__ float least_of_warp(float value) {
  for (int step = 16; step; step /= 2) value = fminf(value, __shfl_xor_sync(kWarp, value, step));
  return value;
}

__global__ void __launch_bounds__(kThreads)
    lens_table_kernel(const int32_t* halted, const __grid_constant__ Lens<double> lens, Image image, float* out) {
  if (!begin_work(halted)) return;
  __shared__ TileDirections directions;
  __shared__ TileFrame<float> frame;
  __shared__ float least[4][kThreads / 32];
  const int tile = blockIdx.x, across = tile_count(image.width), at = threadIdx.x;
  const int x = tile % across * kTile + at % kTile, y = tile / across * kTile + at / kTile;
  const bool inside = x < image.width && y < image.height;
  directions[at] = inside ? direction_of(lens, x, y) : Direction{};
  __syncthreads();
  if (at == 0) frame = frame_of<float>(directions, lens);
  __syncthreads();
  Place<float> place = {NAN, NAN};
  if (is_shown(directions[at])) place = place_in(frame, directions[at]);
  float* places = const_cast<float*>(places_of<float>(out, image, tile));
  places[at] = place.x, places[kThreads + at] = place.y;
  const float ends[] = {place.x, -place.x, place.y, -place.y};
  for (int k = 0; k < 4; ++k) {
    const float of_warp = least_of_warp(ends[k]);  // of numbers alone
    if (at % 32 == 0) least[k][at / 32] = of_warp;
  }
  __syncthreads();
  if (at) return;
  float all[4];
  for (int k = 0; k < 4; ++k) {
    all[k] = least[k][0];
    for (int warp = 1; warp < kThreads / 32; ++warp) all[k] = fminf(all[k], least[k][warp]);
  }
  float* row = out + kFrameValues * tile;
  store3(row, frame.at), store3(row + 3, frame.across), store3(row + 6, frame.down);
  const bool any = all[0] == all[0];
  row[9] = any ? all[0] : 1, row[10] = any ? -all[1] : -1, row[11] = any ? all[2] : 1, row[12] = any ? -all[3] : -1;
  row[13] = row[14] = row[15] = 0;
}

}  // namespace

template <>
void lens_table<float>(const Queue& queue, const Lens<double>& lens, Image image, float* out) {
  launch(queue, "lens_table", lens_table_kernel, unsigned(tiles_of(image)), kThreads, lens, image, out);
}

}  // namespace cuda
}  // namespace gs
