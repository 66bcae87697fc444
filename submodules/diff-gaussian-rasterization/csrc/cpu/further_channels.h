#pragma once
// The channels behind the first four, which blending takes as it takes colours (tile_chunk.h). For them it finds once
// what a splat weighs at a tile's pixels; then they take the weights in groups. The forward fuses products by name, or
// a compiler would fuse some of them: a channel would have other bits by its place.
#include <vector>

#include "gs/lane_halves.h"
#include "tile_chunk.h"

GS_ISA_BEGIN

namespace {

constexpr int kChunk = 128;  // splats that a forward holds at once, some 6 KB of floats
constexpr int kGroup = 8;    // of channels

// A tile's picture of them. Colours have none.
template <class T, int kPayload>
struct FurtherPlanes {
  FurtherPlanes(const BlendInput<T>&, int64_t) {}
  T cap() const { return T(kMaxAlpha); }
  T* plane(int64_t) { return nullptr; }
};
template <class T>
class FurtherPlanes<T, kChannels> {
  using S = Simd<T>;
  using V = typename S::Vec;

 public:
  FurtherPlanes(const BlendInput<T>& in, int64_t tile)
      : channels_(in.channels),
        instances_(in.instances + in.ranges[tile]),
        planes_(std::max<int64_t>(in.channels.count - kLeading, 0) * kPixels) {}

  T cap() const { return channels_.cap; }
  T* plane(int64_t channel) { return planes_.data() + (channel - kLeading) * kPixels; }

  // A splat of the tile's list, and its weights at a strip's pixels.
  void weigh(int64_t position, V weight) {
    weights_[count_] = weight, rows_[count_++] = channels_.of(instances_[position]);
  }

  // Stores the strip's sums of channels. A value that is not finite takes no part where its splat does not reach; to
  // test every weight for that would cost a tenth.
  template <int kCount>
  void store(int64_t first, const V (&sums)[kCount], T* to) const {
    V none = {};
    for (int c = 0; c < kCount; ++c) none += 0 * sums[c];
    if (S::any(none != none)) return add_reached(first, std::min(first + kCount, channels_.count), to);
    for (int c = 0; c < kCount; ++c) S::store(to + c * kPixels, sums[c]);
  }

  // Adds what was weighed to the strip, whose pixels begin at `at`.
  void add(int at) {
    int64_t c = kLeading;
    for (; c + kGroup <= channels_.count; c += kGroup) add_group<kGroup>(c, plane(c) + at);
    for (; c < channels_.count; ++c) add_group<1>(c, plane(c) + at);
    count_ = 0;
  }

 private:
  template <int kCount>
  void add_group(int64_t first, T* to) const {
    V sums[kCount];
    for (int c = 0; c < kCount; ++c) sums[c] = S::load(to + c * kPixels);
    for (int i = 0; i < count_; ++i)
      for (int c = 0; c < kCount; ++c) sums[c] = S::multiply_add(weights_[i], S::all(rows_[i][first + c]), sums[c]);
    store(first, sums, to);
  }

  __attribute__((noinline)) void add_reached(int64_t first, int64_t end, T* to) const {
    for (int64_t c = first; c < end; ++c, to += kPixels) {
      V sum = S::load(to);
      for (int i = 0; i < count_; ++i)
        sum = weights_[i] > 0 ? S::multiply_add(weights_[i], S::all(rows_[i][c]), sum) : sum;
      S::store(to, sum);
    }
  }

  const Channels<T>& channels_;
  const int32_t* instances_;
  std::vector<T> planes_;
  V weights_[kChunk];
  const T* rows_[kChunk];
  int count_ = 0;
};

// The rows of a pass's channels, (rows, kMostChannels), or null. adds: whether gradient rows have sums of other passes.
template <class T>
struct PassRows {
  T* channels = nullptr;
  bool adds = false;
};

// The image's gradients of them at a tile's pixels, and their sums of a splat. Colours have none.
template <class T, int kPayload>
struct FurtherSums {
  explicit FurtherSums(const Channels<T>&) {}
  T cap() const { return T(kMaxAlpha); }
  T* plane(int64_t) { return nullptr; }
};
template <class T>
class FurtherSums<T, kChannels> {
  using S = Simd<T>;
  using V = typename S::Vec;

 public:
  explicit FurtherSums(const Channels<T>& channels)
      : channels_(channels), end_(channels.stops ? channels.cap : std::numeric_limits<T>::infinity()) {}

  bool finite = true;  // whether all gradients of the tile are

  T cap() const { return channels_.cap; }
  T* plane(int64_t channel) { return planes_[channel - kLeading]; }

  void start(int64_t splat) { values_ = channels_.of(splat), count_ = 0; }

  // `value` and what these channels add to the loss, at a vector of pixels.
  V value(V value, int at) const {
    for (int64_t c = kLeading; c < channels_.count; ++c)
      value = S::multiply_add(S::all(values_[c]), S::load(planes_[c - kLeading] + at), value);
    return value;
  }
  V slope(V q, V uncapped) const { return uncapped > end_ ? V{} : q; }
  void weigh(int at, V weight) { reached_[count_++] = {weight, at}; }

  // Puts the splat's sums into its row, which is number `number`, and into that of its channels.
  template <int kRow>
  void store(T (&sums)[kRow], const PassRows<T>& pass, int64_t number, T* row) const {
    constexpr int kFirst = kGradientValues - kLeading;  // of the channels
    if (pass.channels) {
      T* to = pass.channels + kMostChannels * number;
      std::copy_n(sums + kFirst, kLeading, to);
      for (int64_t c = kLeading; c < channels_.count; c += kGroup) store_group(c, to);
    }
    sums[kGradientValues - 1] = 0;  // a channel is no inverse depth
    for (int v = 0; v < kRow; ++v) {
      const bool channel = v >= kFirst && v < kGradientValues;
      if (pass.adds) sums[v] = channel ? row[v] : row[v] + sums[v];
    }
    std::copy_n(sums, kRow, row);
  }

 private:
  struct Reached {
    V weight;
    int at;
  };

  void store_group(int64_t first, T* to) const {  // planes beyond the last one are zero
    V sums[kGroup] = {};
    const auto gradient = [&](int i, int c) { return S::load(planes_[first - kLeading + c] + reached_[i].at); };
    if (finite)
      for (int i = 0; i < count_; ++i)
        for (int c = 0; c < kGroup; ++c) sums[c] = S::multiply_add(reached_[i].weight, gradient(i, c), sums[c]);
    else
      for (int i = 0; i < count_; ++i)
        for (int c = 0; c < kGroup; ++c)
          sums[c] = S::multiply_add(reached_[i].weight, reached_[i].weight > 0 ? gradient(i, c) : V{}, sums[c]);
    T group[kGroup];
    LaneSums<T, int(sizeof sums[0])>::store(sums, group);
    std::copy_n(group, std::min<int64_t>(kGroup, kMostChannels - first), to + first);
  }

  const Channels<T>& channels_;
  T end_;
  alignas(64) T planes_[kMostChannels][kPixels] = {};
  Reached reached_[kPixels / S::kLanes + kTile];
  const T* values_ = nullptr;
  int count_ = 0;
};

}  // namespace

GS_ISA_END
