#pragma once
// Slots, the places of the instances' gradients: sorted by splat, while instances are sorted by tile. A slot is a tile
// of a splat's rectangle, reached or not. So an instance finds its slot, and a splat finds its instances' slots,
// without a list of either.
#include <cstdint>

#include "../data.h"
#include "load.h"
#include "tiles.h"

GS_ISA_BEGIN

GS_HD int64_t slot_count(TileRect rect) { return int64_t(rect.x1 - rect.x0) * (rect.y1 - rect.y0); }

// first: the number of slots of all splats before.
GS_HD SplatSlots splat_slots(int64_t first, TileRect rect) {
  const int32_t wide = rect.x1 - rect.x0;
  return {first, rect.y0 * wide + rect.x0, wide};
}

GS_HD int64_t slot_of(const SplatSlots* slots, int32_t splat, int tile_x, int tile_y) {
  const SplatSlots s = load_whole(slots + splat);
  return s.first + int64_t(tile_y) * s.wide + tile_x - s.skipped;
}

GS_ISA_END
