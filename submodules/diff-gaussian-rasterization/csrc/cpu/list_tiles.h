#pragma once
#include "../data.h"
#include "../math/tiles.h"

GS_ISA_BEGIN

// Writes the tiles that a splat reaches to `tiles` (unless null) and returns how many. One compiled function for both
// uses: inlined twice it could be rounded two ways, and counting must agree with emission.
template <class T>
int32_t list_tiles(const Splat<T>& splat, TileRect rect, Image image, int32_t* tiles);

GS_ISA_END
