#pragma once
// Stable sorts by counting, in parallel. The result does not depend on the number of threads.
#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "gs/isa.h"
#include "gs/parallel.h"

GS_ISA_BEGIN

// A cut of [0, n) into parts. Each part counts for itself, so the places of its elements are those of a serial sort for
// any cut.
struct Parts {
  int64_t n, count;

  Parts(int64_t n, int64_t most) : n(n), count(std::max<int64_t>(1, std::min(most, n / 4096))) {}

  // Calls body(part, begin, end).
  template <class Body>
  void run(const Executor& executor, const Body& body) const {
    for_dynamic(executor, count, 1, [&](int64_t p, int64_t) { body(p, n * p / count, n * (p + 1) / count); });
  }
};

// How many elements of each part fall into each bucket; then the place of the next of them.
class Places {
 public:
  Places(int64_t parts, int64_t buckets) : parts_(parts), buckets_(buckets), counts_(parts * buckets, 0) {}

  int64_t* of(int64_t part) { return counts_.data() + part * buckets_; }

  // Turns the counts into places. `starts` (buckets + 1), if given, receives where each bucket begins.
  void find(int64_t* starts = nullptr) {
    int64_t total = 0;
    for (int64_t b = 0; b < buckets_; ++b) {
      if (starts) starts[b] = total;
      for (int64_t p = 0; p < parts_; ++p) {
        const int64_t here = of(p)[b];
        of(p)[b] = total;
        total += here;
      }
    }
    if (starts) starts[buckets_] = total;
  }

 private:
  int64_t parts_, buckets_;
  std::vector<int64_t> counts_;
};

// Memory that is not zeroed.
template <class T>
std::unique_ptr<T[]> uninitialised(int64_t count) {
  return std::unique_ptr<T[]>(new T[count]);
}

// Sorts n entries by their member `key`, an unsigned integer from `least` to `most`: a radix sort, least digit first.
template <class Entry, class Key>
void sort_by_key(const Executor& executor, int64_t n, std::unique_ptr<Entry[]>& entries, Key least, Key most) {
  constexpr int kMostBits = 11;
  int bits = 0;
  while (n > 1 && bits < int(8 * sizeof(Key)) && Key(most - least) >> bits) ++bits;
  const int passes = (bits + kMostBits - 1) / kMostBits;
  if (passes == 0) return;
  const int digit = (bits + passes - 1) / passes;
  const Key mask = (Key(1) << digit) - 1;
  std::unique_ptr<Entry[]> other = uninitialised<Entry>(n);
  const Parts parts(n, executor.threads);
  for (int shift = 0; shift < bits; shift += digit) {
    Places places(parts.count, int64_t(1) << digit);
    const Entry* from = entries.get();
    Entry* to = other.get();
    parts.run(executor, [&](int64_t p, int64_t begin, int64_t end) {
      int64_t* counts = places.of(p);
      for (int64_t i = begin; i < end; ++i) ++counts[(from[i].key - least) >> shift & mask];
    });
    places.find();
    parts.run(executor, [&](int64_t p, int64_t begin, int64_t end) {
      int64_t* place = places.of(p);
      for (int64_t i = begin; i < end; ++i) to[place[(from[i].key - least) >> shift & mask]++] = from[i];
    });
    entries.swap(other);
  }
}

GS_ISA_END
