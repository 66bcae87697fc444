#pragma once
// The tiles that a splat reaches.
#include "../data.h"
#include "../math/tiles.h"

GS_ISA_BEGIN

constexpr int kMasked = 64;  // a rectangle of at most this many tiles has a bit for each

inline bool masked(TileRect rect) { return int64_t(rect.x1 - rect.x0) * (rect.y1 - rect.y0) <= kMasked; }

// Returns the number of tiles of its rectangle that a splat reaches, and in `mask` a bit for each of them, row by row,
// or 0 if there are too many. Writes their numbers to `tiles`, unless that is null. Counting and emission call one
// compiled function: inlined twice, it could round in two ways, and the two must agree.
// table: as in Projected.
template <class T>
int32_t list_tiles(const Splat<T>& splat, TileRect rect, Image image, const T* table, uint64_t& mask, int32_t* tiles);
template <class T>
int32_t list_tiles(const RaySplat<T>& splat, TileRect rect, Image image, const T* table, uint64_t& mask,
                   int32_t* tiles);
template <class T>
int32_t list_tiles(const LensRaySplat<T>& splat, TileRect rect, Image image, const T* table, uint64_t& mask,
                   int32_t* tiles);

GS_ISA_END
