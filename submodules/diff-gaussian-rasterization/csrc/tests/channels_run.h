#pragma once
// A forward and a backward of many channels through a backend.
#include <numeric>
#include <vector>

#include "backend_run.h"

struct ChannelsRun {
  std::vector<float> color, transmittance, rows, values;
  std::vector<int32_t> last, counts;
  int row;  // values of a gradient row

  bool operator==(const ChannelsRun& other) const {
    return color == other.color && transmittance == other.transmittance && rows == other.rows &&
           values == other.values && last == other.last && counts == other.counts;
  }
};

// The gradient of every value of the image is 1 / channels, and of every transmittance 1. stops: gradients end at a cap
// of 0.9.
template <class Where>
ChannelsRun run_channels(const Where& where, Parameters<float>& p, gs::Image image, int64_t channels, bool absolute,
                         bool stops) {
  using gs::cuda::blend, gs::cuda::blend_rows, gs::GS_ISA::blend, gs::GS_ISA::blend_rows;
  const auto r = bin_scene(where, scene_of(p, image, false), Asked{});
  const size_t pixels = r->pixels();
  std::vector<float> values(p.count * channels), background(channels, 0.2f), planes(channels * pixels, 1.0f / channels);
  for (size_t i = 0; i < values.size(); ++i) values[i] = float(int(i * 7 % 11) - 4) / 5;
  const gs::BlendInput<float> in{r->splats.data(),
                                 r->instances.data(),
                                 r->ranges.data(),
                                 background.data(),
                                 image,
                                 int64_t(r->instances.size()),
                                 r->scene.rays(),
                                 nullptr,
                                 {values.data(), channels, channels, stops ? 0.9f : 0.99f, stops}};
  ChannelsRun out;
  out.color.assign(channels * pixels, NAN), out.transmittance.assign(pixels, NAN), out.last.assign(pixels, -77);
  blend(where, in, gs::Blended<float>{out.color.data(), out.transmittance.data(), nullptr, out.last.data(), nullptr});
  const std::vector<float> ones(pixels, 1);
  const gs::BlendGradient<float> g{
      p.count,         in.instance_count, r->slot_count, r->slots.data(), out.transmittance.data(),
      out.last.data(), planes.data(),     nullptr,       ones.data(),     nullptr,
      nullptr};
  out.row = gradient_row(in.rays) + (absolute ? 2 : 0);
  out.values.assign(values.size(), NAN), out.counts.assign(p.count, -77);
  const auto take = [](void* context, int64_t count) {
    auto& to = *static_cast<ChannelsRun*>(context);
    to.rows.assign(count * to.row, NAN);
    return to.rows.data();
  };
  blend_rows(where, in, g, gs::RowMemory<float>{take, &out, out.counts.data(), absolute, out.values.data()});
  const size_t filled = out.row * std::accumulate(out.counts.begin(), out.counts.end(), size_t(0));
  CHECK(out.rows.size() >= filled);
  out.rows.resize(filled);
  return out;
}
