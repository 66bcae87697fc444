// Packs splats for other processes, and brings rows that come from these into the order of one.
#include <algorithm>
#include <vector>

#include "../backend.h"
#include "../math/splat.h"

namespace gs {

namespace {

constexpr int64_t kGrain = 4096;

}  // namespace

void pack_splats(const Executor& executor, const PackInput& in) {
  const int values = baseline::kSplatValues * in.wide;
  executor.run(in.count, kGrain, [&](int64_t begin, int64_t end) {
    int32_t* to = in.packed + packed_words(in.wide) * begin;
    for (int64_t i = begin; i < end; ++i) {
      const int64_t splat = in.gaussians[i];
      to = std::copy_n(in.splats + values * splat, values, to);
      to = std::copy_n(in.depths + in.wide * splat, in.wide, to);
      *to++ = in.tile_counts[splat];
      to = std::copy_n(in.rects + 4 * splat, 4, to);
    }
  });
}

void unpack_splats(const Executor& executor, const UnpackInput& in) {
  const int values = baseline::kSplatValues * in.wide;
  executor.run(in.count, kGrain, [&](int64_t begin, int64_t end) {
    const int32_t* from = in.packed + packed_words(in.wide) * begin;
    for (int64_t i = begin; i < end; ++i) {
      std::copy_n(from, values, in.splats + values * i), from += values;
      std::copy_n(from, in.wide, in.depths + in.wide * i), from += in.wide;
      in.tile_counts[i] = *from++;
      std::copy_n(from, 4, in.rects + 4 * i), from += 4;
    }
  });
}

void move_runs(const Executor& executor, const MoveInput& in) {
  std::vector<int64_t> begins(in.runs), new_begins(in.runs + 1);
  int64_t rows = 0;
  for (int64_t i = 0; i < in.runs; ++i) {
    begins[i] = rows, rows += in.counts[i];
    new_begins[in.places[i] + 1] = in.counts[i];
  }
  for (int64_t place = 0; place < in.runs; ++place) new_begins[place + 1] += new_begins[place];
  executor.run(in.runs, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      std::copy_n(in.from + in.words * begins[i], in.words * int64_t(in.counts[i]),
                  in.to + in.words * new_begins[in.places[i]]);
  });
}

}  // namespace gs
