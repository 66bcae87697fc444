// Binning: splats sorted by depth, then their instances by tile.
#include <algorithm>
#include <cstring>
#include <type_traits>
#include <vector>

#include "../backend.h"
#include "../math/slots.h"
#include "gs/simd.h"
#include "list_tiles.h"

GS_ISA_BEGIN

// Tests the rectangle's tiles row by row, a vector at a time.
template <class T>
__attribute__((noinline)) int32_t list_tiles(const Splat<T>& splat, TileRect rect, Image image, int32_t* tiles) {
  using S = Simd<T>;
  using V = typename S::Vec;
  using M = typename S::Mask;
  T lanes[S::kLanes];
  for (int i = 0; i < S::kLanes; ++i) lanes[i] = T(i);
  const V lane = S::load(lanes);
  const TileTest<T> test = make_tile_test(splat, rect, image.width, image.height);
  const int wide = rect.x1 - rect.x0, columns = tile_count(image.width);
  int32_t count = 0;
  int row = rect.y0, column = 0;
  for (int left = wide * (rect.y1 - rect.y0); left > 0; left -= S::kLanes) {
    const V along = lane + T(column);
    const M down = __builtin_convertvector((along + T(0.5)) / T(wide), M);
    const V x = along - __builtin_convertvector(down, V) * T(wide) + T(rect.x0);
    const V y = __builtin_convertvector(down, V) + T(row);
    uint32_t reached = S::bits(tile_reached(test, x, y));
    if (left < S::kLanes) reached &= (1u << left) - 1;
    if (tiles) {
      const M tile = (down + row) * columns + __builtin_convertvector(x, M);
      for (uint32_t bits = reached; bits; bits &= bits - 1) *tiles++ = int32_t(tile[__builtin_ctz(bits)]);
    }
    count += __builtin_popcount(reached);
    column += S::kLanes;
    row += column / wide, column %= wide;
  }
  return count;
}
template int32_t list_tiles<float>(const Splat<float>&, TileRect, Image, int32_t*);
template int32_t list_tiles<double>(const Splat<double>&, TileRect, Image, int32_t*);

namespace {

// Sorts [0, n) stably by digit(i) < buckets; emit(i, place) gets each element's place. Each thread has a part of the
// elements and its own counts, so the places are those of a serial sort for any cut. `starts` (buckets + 1), if given,
// receives where each bucket begins.
template <class Digit, class Emit>
void counting_sort(const Executor& executor, int64_t n, int64_t buckets, int64_t* starts, const Digit& digit,
                   const Emit& emit) {
  const int64_t parts = std::max<int64_t>(1, std::min<int64_t>(executor.threads, n / 4096));
  std::vector<int64_t> counts(parts * buckets, 0);
  const auto part_of = [&](int64_t p) { return n * p / parts; };
  executor.run(parts, 1, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p)
      for (int64_t i = part_of(p); i < part_of(p + 1); ++i) ++counts[p * buckets + digit(i)];
  });
  int64_t total = 0;
  for (int64_t b = 0; b < buckets; ++b) {
    if (starts) starts[b] = total;
    for (int64_t p = 0; p < parts; ++p) {
      const int64_t here = counts[p * buckets + b];
      counts[p * buckets + b] = total;
      total += here;
    }
  }
  if (starts) starts[buckets] = total;
  executor.run(parts, 1, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p)
      for (int64_t i = part_of(p); i < part_of(p + 1); ++i) emit(i, counts[p * buckets + digit(i)]++);
  });
}

// Sorts splats by depth: a radix sort, least digit first. Depths are positive, so their bits order them. Equal depths
// keep the order of their indices.
template <class T>
void sort_by_depth(const Executor& executor, const T* depths, std::vector<int32_t>& order) {
  using Key = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
  struct Entry {
    Key key;
    int32_t splat;
  };
  const int64_t n = int64_t(order.size());
  std::vector<Entry> from(n), to(n);
  executor.run(n, 16384, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      std::memcpy(&from[i].key, &depths[order[i]], sizeof(Key));
      from[i].splat = order[i];
    }
  });
  constexpr int kBits = 11;
  for (int shift = 0; shift < int(8 * sizeof(Key)); shift += kBits) {
    counting_sort(
        executor, n, 1 << kBits, nullptr, [&](int64_t i) { return int64_t(from[i].key >> shift & ((1 << kBits) - 1)); },
        [&](int64_t i, int64_t place) { to[place] = from[i]; });
    from.swap(to);
  }
  for (int64_t i = 0; i < n; ++i) order[i] = from[i].splat;
}

}  // namespace

template <class T>
void bin(const Executor& executor, int64_t count, const Projected<T>& projected, Image image, const BinMemory& memory) {
  std::vector<int32_t> order;
  for (int64_t i = 0; i < count; ++i)
    if (projected.tile_counts[i]) order.push_back(int32_t(i));
  sort_by_depth(executor, projected.depths, order);
  const int64_t visible = int64_t(order.size());

  std::vector<int64_t> offsets(visible + 1, 0);
  for (int64_t i = 0; i < visible; ++i) offsets[i + 1] = offsets[i] + projected.tile_counts[order[i]];
  const int64_t instance_count = offsets[visible];
  int64_t slots = 0;
  if (memory.slots) {
    for (int64_t i = 0; i < count; ++i) {
      const int32_t* r = projected.rects + 4 * i;
      const TileRect rect = projected.tile_counts[i] ? TileRect{r[0], r[1], r[2], r[3]} : TileRect{};
      memory.slots[i] = splat_slots(slots, rect);
      slots += slot_count(rect);
    }
    memory.slots[count] = splat_slots(slots, {});
  }
  const Binned out = memory.take(memory.context, instance_count, slots);
  std::vector<int32_t> tiles(instance_count), splats(instance_count);
  for_dynamic(executor, visible, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      Splat<T> splat;
      std::memcpy(&splat, projected.splats + kSplatValues * order[i], sizeof splat);
      const int32_t* r = projected.rects + 4 * order[i];
      list_tiles(splat, TileRect{r[0], r[1], r[2], r[3]}, image, tiles.data() + offsets[i]);
      std::fill(splats.begin() + offsets[i], splats.begin() + offsets[i + 1], order[i]);
    }
  });
  const int64_t tile_total = tiles_of(image);
  counting_sort(
      executor, instance_count, tile_total, out.ranges, [&](int64_t i) { return int64_t(tiles[i]); },
      [&](int64_t i, int64_t place) { out.instances[place] = splats[i]; });
}

template void bin<float>(const Executor&, int64_t, const Projected<float>&, Image, const BinMemory&);
template void bin<double>(const Executor&, int64_t, const Projected<double>&, Image, const BinMemory&);

GS_ISA_END
