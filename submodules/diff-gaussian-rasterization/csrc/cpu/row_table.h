#pragma once
// Where a backward's splats reach: their terms in a tile's rows, and the rows and columns with pixels that they may
// reach. Most splats reach few columns, so a vector takes pixels of one or two rows.
#include "tile_chunk.h"

GS_ISA_BEGIN

namespace {

constexpr int kBatch = 64;  // splats held at once, some 3 KB of floats, and 12 KB of their terms

// A vector has kColumns of a row, or of two rows in turn: most splats reach few columns. Pixels lie in that order.
template <class T>
constexpr int kRows = Simd<T>::kLanes > 8 ? 2 : 1;
template <class T>
constexpr int kColumns = Simd<T>::kLanes / kRows<T>;

// The place of a pixel, whose row is a multiple of kRows.
template <class T>
int place(int row, int column) {
  return row * kTile + column * kRows<T>;
}

// Puts a tile's pixels from rows to their places.
template <class T, class Value>
void interleave(Value* pixels) {
  if constexpr (kRows<T> == 2)
    for (Value* pair = pixels; pair < pixels + kPixels; pair += 2 * kTile) {
      Value rows[2 * kTile];
      std::copy_n(pair, 2 * kTile, rows);
      for (int c = 0; c < kTile; ++c) pair[2 * c] = rows[c], pair[2 * c + 1] = rows[kTile + c];
    }
}

// The vector of a row's value, or of two rows' in turn.
template <class T>
typename Simd<T>::Vec by_rows(const T (&values)[kTile][kBatch], int row, int k) {
  using S = Simd<T>;
  if constexpr (kRows<T> == 1) return S::all(values[row][k]);
  typename S::Mask odd;
  for (int i = 0; i < S::kLanes; ++i) odd[i] = -(i % 2);
  return odd ? S::all(values[row + kRows<T> - 1][k]) : S::all(values[row][k]);
}

// The columns of a vector's pixels.
template <class T>
typename Simd<T>::Vec columns_from(int first) {
  T x[Simd<T>::kLanes];
  for (int i = 0; i < Simd<T>::kLanes; ++i) x[i] = T(first + i / kRows<T>);
  return Simd<T>::load(x);
}

template <class T, int kRays>
struct BackwardState {
  TilePlaces<T, kRays> places, in_place;  // in_place: the same, as all that follows
  alignas(64) T transmittance[kPixels], behind[kPixels];
  alignas(64) T payload[kLeading][kPixels];  // the image's gradient
  alignas(64) typename IntOf<T>::type last[kPixels];
  alignas(64) typename IntOf<T>::type row_last[kTile];  // the largest in a row
};

// The columns that each splat of a chunk can reach, first <= column <= last; the exact test follows. As in tile_rect,
// with its margins.
template <class T>
struct ColumnRanges {
  int32_t first[kBatch], last[kBatch];

  void find(const Chunk<T, kBatch, kNoRays>& chunk, int64_t count, const TilePlaces<T, kNoRays>&) {
    for (int64_t k = 0; k < count; ++k) {
      const T slope = chunk.l12[k] / chunk.l22[k];
      const T level = larger(chunk.log2_opacity[k] - T(kLog2MinAlpha), T(0));
      const T reach = std::sqrt(level) * T(1.0001) + T(0.01);
      const T dx = reach * std::sqrt(1 + slope * slope) / chunk.l11[k] + T(0.01);
      set(k, chunk.x[k] - dx, chunk.x[k] + dx);
    }
  }
  // By the places of each column's pixels.
  void find(const Chunk<T, kBatch, kLensRays>& chunk, int64_t count, const TilePlaces<T, kLensRays>& places) {
    T least[kTile], most[kTile];
    for (int c = 0; c < kTile; ++c) {
      least[c] = most[c] = places.x[c];
      for (int p = c + kTile; p < kPixels; p += kTile)
        least[c] = std::min(least[c], places.x[p]), most[c] = std::max(most[c], places.x[p]);
    }
    for (int64_t k = 0; k < count; ++k) {
      const XLimits<T> limits = x_limits(chunk.template terms<T>(k));
      first[k] = 0, last[k] = kTile - 1;
      while (first[k] < kTile - 1 && most[first[k]] < limits.low) ++first[k];
      while (last[k] > first[k] && least[last[k]] > limits.high) --last[k];
    }
  }
  void find(const Chunk<T, kBatch, kPinholeRays>& chunk, int64_t count, const TilePlaces<T, kPinholeRays>&) {
    for (int64_t k = 0; k < count; ++k) {
      RaySplat<T> splat = {};
      splat.l11 = chunk.l11[k], splat.l12 = chunk.l12[k], splat.l22 = chunk.l22[k];
      splat.log2_opacity = chunk.log2_opacity[k], splat.slope_u = chunk.slope_u[k];
      splat.slope_v = chunk.slope_v[k], splat.e = chunk.e[k];
      const Extent<T> to = extent_of(splat);
      set(k, chunk.x[k] - to.left, chunk.x[k] + to.right);
    }
  }

 private:
  void set(int64_t k, T left, T right) {
    const T end = T(kTile - 1);
    first[k] = int32_t(left > 0 ? (left < end ? left : end) : T(0));  // what is not a number reaches all columns
    last[k] = int32_t(right < end ? (right > 0 ? right : T(0)) : end);
  }
};

// The terms of a batch's splats in all rows, RowTerms or RayRow.
template <class T, int kRays>
struct TermTable {
  using V = typename Simd<T>::Vec;
  alignas(64) T top[kTile][kBatch], u0[kTile][kBatch], v[kTile][kBatch];
  void store(int row, int64_t k, const RowTerms<V>& terms) {
    using S = Simd<T>;
    S::store(top[row] + k, terms.top), S::store(u0[row] + k, terms.u0), S::store(v[row] + k, terms.v);
  }
  RowTerms<V> of(const Chunk<T, kBatch, kNoRays>& chunk, int row, int k) const {
    return {by_rows<T>(top, row, k), Simd<T>::all(chunk.l11[k]), by_rows<T>(u0, row, k), by_rows<T>(v, row, k)};
  }
};
template <class T>
struct TermTable<T, kPinholeRays> {
  using V = typename Simd<T>::Vec;
  alignas(64) T u0[kTile][kBatch], v[kTile][kBatch];
  void store(int row, int64_t k, const RayRow<V>& terms) {
    Simd<T>::store(u0[row] + k, terms.flat.u0), Simd<T>::store(v[row] + k, terms.flat.v);
  }
  RayRow<V> of(const Chunk<T, kBatch, kPinholeRays>& chunk, int row, int k) const {
    using S = Simd<T>;
    return ray_row<V>(
        {S::all(chunk.log2_opacity[k]), S::all(chunk.l11[k]), by_rows<T>(u0, row, k), by_rows<T>(v, row, k)},
        S::all(chunk.slope_u[k]), S::all(chunk.slope_v[k]), S::all(chunk.e[k]));
  }
};

template <class T>
struct TermTable<T, kLensRays> {
  LensTerms<T> of(const Chunk<T, kBatch, kLensRays>& chunk, int, int k) const { return chunk.template terms<T>(k); }
};

// The same, and the rows with pixels that each may reach.
template <class T, int kRays>
struct RowTable : TermTable<T, kRays> {
  static constexpr int kParts = kRows<T> == 1 ? 1 : kTile / kColumns<T>;  // of a row
  alignas(64) typename IntOf<T>::type reached[kParts][kBatch];            // a bit for each row

  static auto splats_of(const Chunk<T, kBatch, kRays>& chunk, int64_t k) {
    if constexpr (kRays == kLensRays)
      return chunk.template terms<typename Simd<T>::Vec>(k);
    else
      return chunk.shapes(k);
  }

  // position: of the first splat in the tile's list.
  void fill(const Chunk<T, kBatch, kRays>& chunk, int64_t count, int64_t position,
            const BackwardState<T, kRays>& state) {
    using S = Simd<T>;
    using Int = typename S::Int;
    const typename S::Mask lanes = __builtin_convertvector(lane_numbers<T>(0), typename S::Mask);
    for (int64_t k = 0; k < count; k += S::kLanes) {
      const auto splats = splats_of(chunk, k);
      const typename S::Mask positions = lanes + Int(position + k);
      typename S::Mask bits[kParts] = {};
      for (int row = 0; row < kTile; ++row) {
        constexpr int kPart = kTile / kParts;
        const typename S::Mask wanted = (positions < state.row_last[row]) & Int(1 << row);
        if constexpr (kRays == kLensRays) {
          for (int p = 0; p < kParts; ++p)
            bits[p] |= box_reached(splats, state.places.box(row * kTile + p * kPart, kPart)) & wanted;
        } else {
          const auto terms = row_terms(splats, T(row));
          this->store(row, k, terms);
          for (int p = 0; p < kParts; ++p) bits[p] |= row_reached(terms, T(p * kPart), T((p + 1) * kPart - 1)) & wanted;
        }
      }
      for (int p = 0; p < kParts; ++p) std::memcpy(reached[p] + k, &bits[p], sizeof bits[p]);
    }
  }

  // A bit for each row with which vectors begin: those of which the splat may reach one of theirs, in any part.
  uint32_t rows(int k) const {
    uint32_t bits = 0;
    for (int p = 0; p < kParts; ++p) bits |= rows(k, p);
    return bits;
  }
  uint32_t rows(int k, int part) const {
    const uint32_t bits = uint32_t(reached[part][k]);
    return kRows<T> == 1 ? bits : (bits | bits >> 1) & 0x5555;
  }
};

}  // namespace

GS_ISA_END
