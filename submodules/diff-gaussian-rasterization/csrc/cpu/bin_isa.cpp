// Binning: splats sorted by depth, then their instances by tile.
#include <cstring>
#include <limits>
#include <type_traits>

#include "../backend.h"
#include "../math/slots.h"
#include "counting_sort.h"
#include "list_tiles.h"

GS_ISA_BEGIN

namespace {

// The bits of a depth. Depths are positive, so their bits order them.
template <class T>
using Key = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;

template <class T>
struct Entry {
  Key<T> key;
  int32_t splat;
};

// The tiles of splats that reach one: their rectangle and its mask (list_tiles.h), from a record if there is one.
template <class T>
struct Reached {
  TileRect rect;
  uint64_t mask;  // 0 where there is none

  Reached(const Projected<T>& in, int64_t splat) {
    if (in.records) {
      const TileRecord& r = in.records[splat];
      rect = {r.x0, r.y0, r.x1, r.y1};
      mask = masked(rect) ? r.reached : 0;
    } else {
      const int32_t* r = in.rects + 4 * splat;
      rect = {r[0], r[1], r[2], r[3]};
      mask = 0;
    }
  }
};

// What splats that reach a tile have together.
template <class T>
struct Totals {
  int64_t splats = 0, instances = 0, slots = 0;
  Key<T> least = std::numeric_limits<Key<T>>::max(), most = 0;

  static Key<T> key(const Projected<T>& in, int64_t i) {
    Key<T> key;
    std::memcpy(&key, in.depths + i, sizeof key);
    return key;
  }

  void add(const Projected<T>& in, int64_t i) {
    ++splats, instances += in.tile_counts[i], slots += slot_count(Reached<T>(in, i).rect);
    least = std::min(least, key(in, i)), most = std::max(most, key(in, i));
  }
  void add(const Totals& other) {
    splats += other.splats, instances += other.instances, slots += other.slots;
    least = std::min(least, other.least), most = std::max(most, other.most);
  }
};

// The splats that reach a tile, in the order of their indices.
template <class T>
struct Visible {
  Totals<T> totals;
  std::unique_ptr<Entry<T>[]> entries;

  // slots (n + 1): filled unless null.
  Visible(const Executor& executor, int64_t n, const Projected<T>& in, SplatSlots* slots) {
    const Parts parts(n, executor.threads);
    std::vector<Totals<T>> before(parts.count);
    parts.run(executor, [&](int64_t p, int64_t begin, int64_t end) {
      Totals<T> here;
      for (int64_t i = begin; i < end; ++i)
        if (in.tile_counts[i]) here.add(in, i);
      before[p] = here;
    });
    for (Totals<T>& part : before) {
      const Totals<T> here = part;
      part = totals;
      totals.add(here);
    }
    entries = uninitialised<Entry<T>>(totals.splats);
    parts.run(executor, [&](int64_t p, int64_t begin, int64_t end) {
      Entry<T>* entry = entries.get() + before[p].splats;
      int64_t slot = before[p].slots;
      for (int64_t i = begin; i < end; ++i) {
        const bool seen = in.tile_counts[i] != 0;
        if (seen) *entry++ = {Totals<T>::key(in, i), int32_t(i)};
        if (!slots) continue;
        const TileRect rect = seen ? Reached<T>(in, i).rect : TileRect{0, 0, 0, 0};  // undefined if not seen
        slots[i] = splat_slots(slot, rect);
        slot += slot_count(rect);
      }
    });
    if (slots) slots[n] = splat_slots(totals.slots, {0, 0, 0, 0});
  }
};

// Writes the tiles that a splat reaches, found once more from its values, as no mask was kept.
template <class T, int kRays>
void list_again(const Projected<T>& in, int32_t i, TileRect rect, Image image, int32_t* tiles) {
  SplatOf<T, kRays> splat;
  uint64_t mask;
  std::memcpy(&splat, in.splats + kSplatRow<kRays> * int64_t(i), sizeof splat);
  list_tiles(splat, rect, image, in.table, mask, tiles);
}

// Writes the numbers of the tiles that a splat reaches.
template <class T>
void write_tiles(const Projected<T>& in, int32_t i, Image image, int32_t* tiles) {
  const Reached<T> reached(in, i);
  const TileRect rect = reached.rect;
  if (reached.mask) {
    const int wide = rect.x1 - rect.x0, columns = tile_count(image.width);
    const uint64_t row = ~uint64_t(0) >> (kMasked - wide);
    uint64_t left = reached.mask;
    for (int32_t tile = rect.y0 * columns + rect.x0; left; tile += columns, left = left >> (wide - 1) >> 1)
      for (uint64_t bits = left & row; bits; bits &= bits - 1) *tiles++ = tile + __builtin_ctzll(bits);
  } else {
    by_rays(in.rays, [&](auto rays) { list_again<T, rays>(in, i, rect, image, tiles); });
  }
}

// Emits the splats' instances in the order of `entries`, and sorts them by tile.
template <class T>
void emit(const Executor& executor, const Visible<T>& visible, const Projected<T>& in, Image image, const Binned& out) {
  const Entry<T>* entries = visible.entries.get();
  const Parts parts(visible.totals.splats, 4 * executor.threads);  // near splats have more instances
  std::vector<int64_t> first(parts.count + 1, 0);
  parts.run(executor, [&](int64_t p, int64_t begin, int64_t end) {
    int64_t instances = 0;
    for (int64_t i = begin; i < end; ++i) instances += in.tile_counts[entries[i].splat];
    first[p + 1] = instances;
  });
  for (int64_t p = 0; p < parts.count; ++p) first[p + 1] += first[p];
  const auto tiles = uninitialised<int32_t>(visible.totals.instances);
  const auto splats = uninitialised<int32_t>(visible.totals.instances);
  Places places(parts.count, tiles_of(image));
  parts.run(executor, [&](int64_t p, int64_t begin, int64_t end) {
    int64_t at = first[p], *counts = places.of(p);
    for (int64_t i = begin; i < end; ++i) {
      const int32_t splat = entries[i].splat, count = in.tile_counts[splat];
      write_tiles(in, splat, image, tiles.get() + at);
      for (const int64_t stop = at + count; at < stop; ++at) splats[at] = splat, ++counts[tiles[at]];
    }
  });
  places.find(out.ranges);
  parts.run(executor, [&](int64_t p, int64_t, int64_t) {
    int64_t* place = places.of(p);
    for (int64_t i = first[p]; i < first[p + 1]; ++i) out.instances[place[tiles[i]]++] = splats[i];
  });
}

}  // namespace

template <class T>
void bin(const Executor& executor, int64_t count, const Projected<T>& projected, Image image, const BinMemory& memory) {
  Visible<T> visible(executor, count, projected, memory.slots);
  const Totals<T>& totals = visible.totals;
  const Binned out = memory.take(memory.context, totals.instances, memory.slots ? totals.slots : 0);
  sort_by_key(executor, totals.splats, visible.entries, totals.least, totals.most);
  emit(executor, visible, projected, image, out);
}

template void bin<float>(const Executor&, int64_t, const Projected<float>&, Image, const BinMemory&);
template void bin<double>(const Executor&, int64_t, const Projected<double>&, Image, const BinMemory&);

GS_ISA_END
