#pragma once
// A forward and a backward of many channels through a backend.
#include <numeric>
#include <vector>

#include "backend_run.h"

struct ChannelsRun {
  std::vector<float> color, transmittance, moments, lengths, values;
  std::vector<int32_t> last;

  bool operator==(const ChannelsRun& other) const {
    return color == other.color && transmittance == other.transmittance && moments == other.moments &&
           lengths == other.lengths && values == other.values && last == other.last;
  }
};

// The gradient of every value of the image is 1 / channels, and of every transmittance 1. stops: gradients end at a cap
// of 0.9. The channels of odd numbers are an image's last axis.
template <class Where>
ChannelsRun run_channels(const Where& where, Parameters<float>& p, gs::Image image, int64_t channels, bool absolute,
                         bool stops) {
  using gs::cuda::blend, gs::cuda::blend_vjp, gs::GS_ISA::blend, gs::GS_ISA::blend_vjp;
  const auto r = bin_scene(where, scene_of(p, image, false), Asked{});
  const size_t pixels = r->pixels();
  const bool last = channels % 2;
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
                                 {values.data(), channels, channels, stops ? 0.9f : 0.99f, stops,
                                  last ? 1 : int64_t(pixels), last ? channels : 1}};
  ChannelsRun out;
  out.color.assign(channels * pixels, NAN), out.transmittance.assign(pixels, NAN), out.last.assign(pixels, -77);
  blend(where, in, gs::Blended<float>{out.color.data(), out.transmittance.data(), nullptr, out.last.data(), nullptr});
  const std::vector<float> ones(pixels, 1);
  const size_t row = gradient_row(in.rays);
  out.moments.assign(p.count * row, NAN), out.values.assign(values.size(), NAN);
  out.lengths.assign(absolute ? p.count : 0, NAN);
  gs::BlendGradient<float> g{
      p.count,         in.instance_count, r->slot_count, r->slots.data(), out.transmittance.data(),
      out.last.data(), planes.data(),     nullptr,       ones.data(),     out.moments.data(),
      nullptr};
  g.absolute = absolute ? out.lengths.data() : nullptr, g.values = out.values.data();
  blend_vjp(where, in, g);
  return out;
}
