#pragma once
// Records listed, and runs of rows added up, on the CPU or by the CUDA kernels.
#include <algorithm>
#include <numeric>
#include <random>
#include <vector>

#include "backend_run.h"

// Splats with rectangles, a quarter of them without tiles, and bands of which one is empty.
struct SomeRects {
  int64_t count;
  int row;  // values of a splat
  std::vector<int32_t> rects, tile_counts, limits;
  std::vector<float> splats, depths;

  SomeRects(int64_t of, int bands, int values) : count(of), row(values), splats(of * values), depths(of) {
    for (std::vector<float>* values_of : {&splats, &depths})
      for (float& value : *values_of) value = float(normal());
    const int rows = 4 * bands;
    for (int64_t i = 0; i < of; ++i) {
      const int top = int(generator() % rows), high = i % 11 ? 1 + int(generator() % 3) : rows;
      for (const int value : {0, top, 5, std::min(top + high, rows)}) rects.push_back(value);
      tile_counts.push_back(generator() % 4 ? 5 : 0);
    }
    for (const int side : {0, 1})
      for (int band = 0; band < bands; ++band)
        limits.push_back(band == 1 ? (side ? -1 : 1 << 30) : 4 * (band + side) - (band == 2 && !side ? 4 : 0));
  }
  gs::RecordInput input() const {
    return {count, int(limits.size() / 2), rects.data(), tile_counts.data(), limits.data()};
  }
};

// The counts, then with one or two empty records for each band, and the lists that follow from them.
struct SomeRecords {
  std::vector<int32_t> found, counts, places, rects, tile_counts;
  std::vector<int64_t> gaussians;
  std::vector<float> splats, depths;

  bool operator==(const SomeRecords& o) const {
    return found == o.found && counts == o.counts && places == o.places && rects == o.rects &&
           tile_counts == o.tile_counts && gaussians == o.gaussians && splats == o.splats && depths == o.depths;
  }
};
template <class Where>
SomeRecords records(const Where& where, const SomeRects& of, int64_t room) {
  using gs::count_records, gs::list_records, gs::cuda::list_records;
  const gs::RecordInput in = of.input();
  const int64_t blocks = gs::record_blocks(in.count);
  SomeRecords out;
  out.found.assign((in.bands + 1) * blocks, -77);
  count_records(where, in, out.found.data());
  for (int band = 0, empty = 0; band <= in.bands; ++band) {
    const auto row = out.found.begin() + band * blocks;
    out.counts.insert(out.counts.end(), row, row + blocks);
    out.counts.push_back(band == in.bands ? empty : 1 + band % 2), empty += 1 + band % 2;
  }
  for (std::vector<int32_t>* list : {&out.places, &out.tile_counts}) list->assign(room, -77);
  out.gaussians.assign(room, -77), out.rects.assign(4 * room, -77);
  out.splats.assign(of.row * room, -77), out.depths.assign(room, -77);
  list_records(where, in,
               gs::RecordLists<float>{room, of.row, out.counts.data(), of.splats.data(), of.depths.data(),
                                      out.gaussians.data(), out.places.data(), out.splats.data(), out.depths.data(),
                                      out.rects.data(), out.tile_counts.data()});
  return out;
}

// What is kept of runs of rows: all, their sum, or nothing.
struct SomeSums {
  std::vector<int32_t> counts, kept, places;
  std::vector<float> rows;
  int values;
  int64_t room = 0;

  // moved: into another order of runs, in which many neighbours stay beside each other.
  SomeSums(const std::vector<int32_t>& of, int values_of_row, bool moved = false) : counts(of), values(values_of_row) {
    const int32_t runs = int32_t(counts.size()), third = runs / 3;
    for (int32_t i = 0; moved && i < runs; ++i)
      places.push_back(i < third ? 2 * i : i < 2 * third ? 2 * (i - third) + 1 : runs - 1 - (i - 2 * third));
    for (size_t i = 0; i < counts.size(); ++i)
      kept.push_back(i % 7 == 3 ? 0 : i % 5 == 2 || (i && counts[i] > 400) ? counts[i] : 1);
    for (int64_t k = 0; k < values * std::accumulate(counts.begin(), counts.end(), int64_t(0)); ++k)
      rows.push_back(float(normal()));
    room = std::accumulate(kept.begin(), kept.end(), int64_t(0)) + 2;
  }
};

template <class Where>
std::vector<float> sum(const Where& where, const SomeSums& s) {
  using gs::sum_runs, gs::cuda::sum_runs;
  std::vector<float> to(s.values * s.room, -77.0f);
  sum_runs(where, gs::SumInput<float>{int64_t(s.counts.size()), int64_t(s.rows.size()) / s.values, s.room, s.values,
                                      s.counts.data(), s.kept.data(), s.rows.data(), to.data(),
                                      s.places.empty() ? nullptr : s.places.data()});
  return to;
}

// No run, one, empty ones alone, some among empty ones, and giants that begin or end where a warp does, or between.
inline std::vector<std::vector<int32_t>> counts_of_runs() {
  std::vector<std::vector<int32_t>> all = {{}, {1}, {32}, {700}, std::vector<int32_t>(300, 0), {32, 64, 0, 96, 1, 31}};
  std::vector<int32_t> few(900, 0), many(600);
  for (size_t i = 5; i < few.size(); i += 97) few[i] = 1 + int32_t(i % 3);
  for (int32_t& count : many) count = int32_t(generator() % 4);
  many[0] = 1000, many[301] = 37, many[599] = 500;
  all.push_back(few), all.push_back(many);
  return all;
}
