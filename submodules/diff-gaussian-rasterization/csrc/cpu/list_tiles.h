#pragma once
// The list of the tiles that a splat reaches.
#include "../data.h"
#include "../math/tiles.h"

GS_ISA_BEGIN

// Writes the tiles that a splat reaches to `tiles`, unless that is null, and returns their number. Counting and
// emission call one compiled function: inlined twice, it could round in two ways, and the two must agree.
template <class T>
int32_t list_tiles(const Splat<T>& splat, TileRect rect, Image image, int32_t* tiles);

GS_ISA_END
