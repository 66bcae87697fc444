#pragma once
// What both kernels of L1 and SSIM have in common: the cut of an image into tiles, its pixels, and the maps that the
// forward hands to the backward. Like the files of the two kernels, this includes no CUDA runtime, so that csrc/tests
// runs the same lines on the host.
//
// A block takes one tile. Its threads work in two layouts. Down the columns, each takes one column of the tile and of
// kRadius columns on either side: it reads each pixel once into registers, and has all rows there. Across, each takes
// four neighbours of a row: it reads 16 values of shared memory for 44 taps. In between lie the sums down the columns,
// in shared memory.
#include <cmath>
#include <cstdint>

#include "data.h"
#include "math/ssim_group.h"

GS_ISA_BEGIN

constexpr int kColumns = 128;  // threads of a block
constexpr int kTileColumns = (kColumns - kReach) / kGroup * kGroup;
constexpr int kLanes = kColumns / kGroup;       // threads to a row when they work across
constexpr int kRowsAcross = kColumns / kLanes;  // rows that they take at once
constexpr int kForwardRows = kBlockRows;
static_assert(kTileColumns == kMapColumns && kTileColumns % kGroup == 0 && kRowsAcross == kGroup);

// 16 bytes of floats, or 4 bytes.
template <class T>
struct alignas(4 * sizeof(T)) Quad {
  T of[4];
};
using Four = Quad<float>;

// A pixel in memory: 8 bytes a load or store.
struct alignas(8) Pair {
  float x1, delta;
  GS_HD operator Pixel<float>() const { return {x1, delta}; }
};

GS_HD float& at(Four* row, int column) { return row[column / 4].of[column % 4]; }
GS_HD float at(const Four* row, int column) { return row[column / 4].of[column % 4]; }

// The 16 values from a multiple of 4 on.
GS_HD void load_row(const Four* row, int first, float (&values)[16]) {
  GS_UNROLL
  for (int i = 0; i < 4; ++i) {
    const Four four = row[first / 4 + i];
    GS_UNROLL
    for (int j = 0; j < 4; ++j) values[4 * i + j] = four.of[j];
  }
}

// Divides by a number that the host knows, without the division that takes a GPU thirty instructions.
struct Divider {
  unsigned by, reciprocal;

  static Divider of(int64_t by) { return {unsigned(by), unsigned(UINT32_MAX / by)}; }
  GS_HD unsigned operator()(unsigned n) const {
    const unsigned less = unsigned(uint64_t(n) * reciprocal >> 32);  // the quotient, or one less
    return n - less * by >= by ? less + 1 : less;
  }
};

// The cut of rows of all planes into tiles, which lie at multiples of their size. It depends on the image's size alone,
// so its sums are the same on every GPU.
struct Tiles {
  int rows, first;  // first: number of the topmost tiles
  Divider across, down;
  int64_t count;

  static Tiles of(int rows, int64_t planes, RowRange range, int64_t width) {
    const int64_t across = (width + kTileColumns - 1) / kTileColumns;
    const int64_t first = range.begin / rows,
                  down = range.begin < range.end ? (range.end + rows - 1) / rows - first : 1;
    return {rows, int(first), Divider::of(across), Divider::of(down),
            range.begin < range.end ? planes * across * down : 0};
  }
};

struct Tile {
  int plane, across;  // number of its plane, and of its strip
  int row, column;    // its first pixel
};

GS_HD Tile tile_of(const Tiles& tiles, unsigned block) {
  const unsigned rest = tiles.across(block), plane = tiles.down(rest);
  const int across = int(block - rest * tiles.across.by), down = int(rest - plane * tiles.down.by);
  return {int(plane), across, (tiles.first + down) * tiles.rows, across * kTileColumns};
}

// A value of the second image while it is on its way: a register has 32 bits.
GS_HD float raw(float v) { return v; }
GS_HD unsigned raw(uint8_t v) { return v; }
template <class Source>
using Raw = decltype(raw(Source()));

GS_HD float to_float(float v) { return v; }

// v / 255, rounded once: 1 / 255 in two parts, the second of them exact enough for the one rounding of the fma.
GS_HD float to_float(unsigned v) {
  constexpr float high = 1.0f / 255, low = float(1.0 / 255 - double(high));
  return std::fma(float(v), high, float(v) * low);
}

// One plane of an image pair; its pixels are zero beyond the border.
template <class Source>
struct Plane {
  const float* img1;
  const Source* img2;
  int height, width;
  bool clamp;

  GS_HD bool has_row(int row) const { return unsigned(row) < unsigned(height); }
  GS_HD bool has_column(int column) const { return unsigned(column) < unsigned(width); }
  GS_HD int64_t offset(int row, int column) const { return int64_t(row) * width + column; }
  GS_HD Pixel<float> pixel(float x1, Raw<Source> x2) const {
    const float used = clamp ? clamp_to_unit(x1) : x1;
    return {used, to_float(x2) - used};
  }
};

// What the backward needs of the forward: value, slope1 and slope_delta of the windows, and anchors, of every fourth
// column. Each strip of a plane, one tile wide, lies on its own, so what a thread loads of one column lies at constant
// distances.
struct Maps {
  float* first;  // row 0 of the image, whether or not it is there
  int height, across;
  int rows;  // that are there

  static constexpr int kAnchors = 3 * kMapColumns;  // begin in a row
  GS_HD float* row(int plane, int strip, int row) const {
    return first + (int64_t(plane * across + strip) * rows + row) * kMapRow;
  }
  GS_HD Pair* anchors(int plane, int strip, int row) const {
    return reinterpret_cast<Pair*>(this->row(plane, strip, row) + kAnchors);
  }
};
static_assert(Maps::kAnchors + 2 * kMapColumns / kGroup <= kMapRow && kMapRow % 4 == 0 && Maps::kAnchors % 2 == 0);

// The row that anchors a block of windows (ssim_group.h), given its first: at the lower border a block may end above
// it.
GS_HD int anchor_row(int first, int height) { return first + kBlockRow < height ? first + kBlockRow : height - 1; }

GS_ISA_END
