#pragma once
// The layers that a GPU's forward makes of the chunks of long lists, for its backward, in images of few tiles. A layer
// stands for a chunk and for all that lies behind it, down to the background, which it lacks: it is what their splats
// add to each pixel of the tile, and the transmittance in front of the chunk. The first chunk of a tile has none.
#include <cstdint>

#include "../data.h"
#include "tiles.h"

GS_ISA_BEGIN

// Images of up to this many tiles do not fill a GPU with blocks and wait for their longest lists, so more warps share a
// tile, and the blocks of a long list's chunks share the list.
constexpr int64_t kFewTiles = 3000;

constexpr int kLayerChunk = 256;  // splats

GS_HD bool makes_layers(Image image) { return tiles_of(image) <= kFewTiles; }

// The place of the layer of a list's chunk number `chunk`, from 1 on; `begin` is where the list begins. All chunks but
// a list's last are full, so no two layers have the same place.
GS_HD int64_t layer_place(int64_t begin, int64_t chunk) { return begin / kLayerChunk + chunk; }

// The pixels of all layers of an image with at most `instances` instances. Each has four floats, colour and
// transmittance; behind all of these each has its inverse depth, if wanted.
GS_HD int64_t layer_pixels(int64_t instances) { return (instances / kLayerChunk + 1) * kTile * kTile; }
GS_HD int64_t layer_values(Image image, int64_t instances, bool inverse_depth) {
  return makes_layers(image) ? (inverse_depth ? 5 : 4) * layer_pixels(instances) : 0;
}

GS_ISA_END
