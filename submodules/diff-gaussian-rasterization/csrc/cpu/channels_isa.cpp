// Blending of many channels. What a strip blends of a chunk is found once, then channels take it in groups.
#include <vector>

#include "blend_tiles.h"

GS_ISA_BEGIN

namespace {

// The splats of a chunk that a strip blends.
template <class T>
struct Blends {
  typename Simd<T>::Vec weights[kChunk];
  const T* rows[kChunk];  // of Channels::values
  int count = 0;

  // Adds kCount channels from `first` on to the strip's pixels at `to`, planes of a tile.
  template <int kCount>
  void add(int64_t first, T* to) const {
    using S = Simd<T>;
    typename S::Vec sums[kCount];
    for (int c = 0; c < kCount; ++c) sums[c] = S::load(to + c * kPixels);
    for (int i = 0; i < count; ++i)
      for (int c = 0; c < kCount; ++c) sums[c] += weights[i] * rows[i][first + c];
    for (int c = 0; c < kCount; ++c) S::store(to + c * kPixels, sums[c]);
  }
};

template <class T, int kRays>
void blend_channels_of_tile(const BlendInput<T>& in, const Channels<T>& channels, int64_t index,
                            const Blended<T>& out) {
  const Tile tile(index, in.image);
  ForwardState<T> state;
  std::fill_n(state.transmittance, kPixels, T(1));
  std::fill_n(state.last, kPixels, 0);
  std::vector<T> planes(channels.count * kPixels);
  const int32_t* instances = in.instances + in.ranges[index];
  Blends<T> blends;
  through_tile<T, kRays>(
      in, tile, index, state.threshold, [&](const auto& chunk, const Strip<T, kRays>& strip, int64_t position) {
        blends.count = 0;
        const bool open = blend_weights<T, true>(chunk, strip, position, channels.cap, state, [&](int k, auto weight) {
          blends.weights[blends.count] = weight;
          blends.rows[blends.count++] = channels.values + channels.stride * instances[position + k];
        });
        constexpr int kGroup = 8;
        int64_t c = 0;
        for (; c + kGroup <= channels.count; c += kGroup)
          blends.template add<kGroup>(c, planes.data() + c * kPixels + strip.at());
        for (; c < channels.count; ++c) blends.template add<1>(c, planes.data() + c * kPixels + strip.at());
        return open;
      });
  for (int64_t c = 0; c < channels.count; ++c) {
    T* plane = planes.data() + c * kPixels;
    for (int p = 0; p < kPixels; ++p) plane[p] += state.transmittance[p] * in.background[c];
    write_tile(plane, in.image, tile, out.color + c * in.image.width * in.image.height);
  }
  write_tile(state.transmittance, in.image, tile, out.transmittance);
  write_tile(state.last, in.image, tile, out.last);
}

}  // namespace

template <class T>
void blend_channels(const Executor& executor, const BlendInput<T>& in, const Channels<T>& channels,
                    const Blended<T>& out) {
  const auto run = in.rays ? blend_channels_of_tile<T, kPinholeRays> : blend_channels_of_tile<T, kNoRays>;
  for_dynamic(executor, tiles_of(in.image), 1, [&](int64_t tile, int64_t) { run(in, channels, tile, out); });
}

#define GS_INSTANTIATE(T) \
  template void blend_channels<T>(const Executor&, const BlendInput<T>&, const Channels<T>&, const Blended<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
