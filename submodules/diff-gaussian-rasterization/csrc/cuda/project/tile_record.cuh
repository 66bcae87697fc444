#pragma once
// Which tiles a splat reaches: in records or, without them, in rectangles.
#include "data.h"
#include "math/load.h"
#include "math/tiles.h"

namespace gs {
namespace cuda {

struct Reached {
  baseline::TileRect rect;  // empty where the splat reaches no tile
  int32_t count;
  uint64_t mask;  // a bit for each tile of the rectangle; 0 where there are too many, or no record
};

__device__ inline Reached reached_by(const Projected<float>& in, int32_t splat) {
  if (in.records) {
    const TileRecord r = baseline::load_whole(in.records + splat);
    const bool masked = (r.x1 - r.x0) * (r.y1 - r.y0) <= 64;
    return {{r.x0, r.y0, r.x1, r.y1}, masked ? __popcll(r.reached) : int32_t(r.reached), masked ? r.reached : 0};
  }
  const int32_t count = in.tile_counts[splat];
  if (!count) return {};  // its rectangle is undefined
  const int4 r = reinterpret_cast<const int4*>(in.rects)[splat];
  return {{r.x, r.y, r.z, r.w}, count, 0};
}

// The record of a splat that reaches `count` tiles. mask: a bit for each of the rectangle's first 64 tiles.
__device__ inline TileRecord tile_record(baseline::TileRect rect, int32_t count, uint64_t mask) {
  if (!count) rect = {0, 0, 0, 0}, mask = 0;
  const uint64_t reached = (rect.x1 - rect.x0) * (rect.y1 - rect.y0) <= 64 ? mask : uint64_t(count);
  return {reached, uint16_t(rect.x0), uint16_t(rect.y0), uint16_t(rect.x1), uint16_t(rect.y1)};
}

}  // namespace cuda
}  // namespace gs
