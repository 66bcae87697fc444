#pragma once
// Rows of tensors, turned into vectors that have a value of several rows, and back.
#include <algorithm>
#include <cstdint>
#include <cstring>

#include "gs/lane_halves.h"

GS_ISA_BEGIN

// As many rows as a vector has lanes. The last ones may repeat the first: only `count` are wanted.
template <class T>
struct Pack {
  int32_t row[Simd<T>::kLanes];
  int count;
};

// Calls body(pack) for packs of the given rows.
template <class T, class Body>
void for_packs(const int32_t* rows, int64_t count, const Body& body) {
  constexpr int kLanes = Simd<T>::kLanes;
  for (int64_t from = 0; from < count; from += kLanes) {
    Pack<T> pack;
    pack.count = int(std::min<int64_t>(kLanes, count - from));
    for (int i = 0; i < kLanes; ++i) pack.row[i] = rows[from + (i < pack.count ? i : 0)];
    body(pack);
  }
}

// The first column of the vector that is to hold column `from` of `count`: the last vector may have columns again.
template <class T>
int first_column(int from, int count) {
  return std::max(0, std::min(from, count - Simd<T>::kLanes));
}

// out[k] = value k of a pack's rows, k < count. The tensor has `n` rows, `stride` values apart. Reads whole vectors,
// but nothing behind the last row.
template <class T>
__attribute__((always_inline)) inline void read_rows(const T* rows, int64_t stride, int64_t n, int count,
                                                     const Pack<T>& pack, typename Simd<T>::Vec* out) {
  using S = Simd<T>;
  const T* end = rows + (n - 1) * stride + count;
  for (int from = 0; from < count; from += S::kLanes) {
    const int first = first_column<T>(from, count), columns = std::min(count, S::kLanes);
    typename S::Vec v[S::kLanes];
    for (int i = 0; i < S::kLanes; ++i) {
      const T* row = rows + pack.row[i] * stride + first;
      if (columns == S::kLanes || end - row >= S::kLanes) {
        v[i] = S::load(row);
      } else {
        T values[S::kLanes] = {};
        for (int k = 0; k < columns; ++k) values[k] = row[k];
        v[i] = S::load(values);
      }
    }
    LaneTranspose<T>::run(v);
    for (int k = 0; k < columns; ++k) out[first + k] = v[k];
  }
}

// Writes value k of a pack's rows from in[k], k < count.
template <class T>
__attribute__((always_inline)) inline void write_rows(const typename Simd<T>::Vec* in, int64_t stride, int count,
                                                      const Pack<T>& pack, T* rows) {
  using S = Simd<T>;
  for (int from = 0; from < count; from += S::kLanes) {
    const int first = first_column<T>(from, count), columns = std::min(count, S::kLanes);
    typename S::Vec v[S::kLanes] = {};
    for (int k = 0; k < columns; ++k) v[k] = in[first + k];
    LaneTranspose<T>::run(v);
    for (int i = 0; i < pack.count; ++i) std::memcpy(rows + pack.row[i] * stride + first, &v[i], columns * sizeof(T));
  }
}

GS_ISA_END
