// Which Gaussians each band of an image gets, as records: counted, then listed.
#include <algorithm>
#include <vector>

#include "../backend.h"

namespace gs {

namespace {

bool reaches(const RecordInput& in, int64_t i, int band) {
  const int32_t* rect = in.rects + 4 * i;
  return in.tile_counts[i] > 0 && rect[1] < in.limits[in.bands + band] && rect[3] > in.limits[band];
}

template <class Body>
void for_blocks(const Executor& executor, const RecordInput& in, const Body& body) {
  for_each_row(executor, record_blocks(in.count), 16, [&](int64_t block) {
    body(block, kRecordBlock * block, std::min(kRecordBlock * (block + 1), in.count));
  });
}

}  // namespace

void count_records(const Executor& executor, const RecordInput& in, int32_t* counts) {
  const int64_t blocks = record_blocks(in.count);
  for_blocks(executor, in, [&](int64_t block, int64_t begin, int64_t end) {
    int32_t all = 0;
    for (int band = 0; band < in.bands; ++band) {
      int32_t total = 0;
      for (int64_t i = begin; i < end; ++i) total += reaches(in, i, band);
      counts[band * blocks + block] = total, all += total;
    }
    counts[in.bands * blocks + block] = all;
  });
}

template <class T>
void list_records(const Executor& executor, const RecordInput& in, const RecordLists<T>& to) {
  const int64_t blocks = record_blocks(in.count) + 1, by_band = in.bands * blocks;
  std::vector<int64_t> begins(by_band + blocks);
  int64_t sum = 0;
  for (int64_t k = 0; k < by_band + blocks; ++k) {
    if (k == by_band) sum = 0;
    begins[k] = sum, sum += to.counts[k];
  }
  const auto write = [&](int64_t at, int64_t place, int64_t i) {
    if (uint64_t(at) >= uint64_t(to.room)) return;
    const bool found = i < in.count;
    const auto copy = [&](auto* from, auto* rows, int64_t values) {
      if (found)
        std::copy_n(from + values * i, values, rows + values * at);
      else
        std::fill_n(rows + values * at, values, 0);
    };
    to.gaussians[at] = i, to.places[at] = int32_t(place);
    copy(to.splats, to.new_splats, to.row), copy(to.depths, to.new_depths, 1);
    copy(in.rects, to.rects, 4), copy(in.tile_counts, to.tile_counts, 1);
  };
  for_blocks(executor, in, [&](int64_t block, int64_t begin, int64_t end) {
    std::vector<int64_t> next(in.bands);
    for (int band = 0; band < in.bands; ++band) next[band] = begins[band * blocks + block];
    int64_t place = begins[by_band + block];
    for (int64_t i = begin; i < end; ++i)
      for (int band = 0; band < in.bands; ++band) {
        if (!reaches(in, i, band)) continue;
        write(next[band]++, place++, i);
      }
  });
  int64_t place = begins.back();
  for (int64_t last = blocks - 1; last < by_band; last += blocks)
    for (int32_t k = 0; k < to.counts[last]; ++k) write(begins[last] + k, place++, in.count);
}

template void list_records<float>(const Executor&, const RecordInput&, const RecordLists<float>&);
template void list_records<double>(const Executor&, const RecordInput&, const RecordLists<double>&);

}  // namespace gs
