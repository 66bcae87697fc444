#pragma once
// Hand-made lists of splats for a row of tiles, blended by a backend.
#include <algorithm>
#include <random>
#include <vector>

#include "backend_run.h"
#include "math/layers.h"
#include "math/slots.h"

// A row of tiles. Each splat lies in one list.
struct LongLists {
  gs::Image image;
  std::vector<float> splats;
  std::vector<int32_t> instances;
  std::vector<int64_t> ranges{0};
  std::vector<gs::SplatSlots> slots;

  explicit LongLists(gs::Image of) : image(of) {}
  int64_t count() const { return int64_t(splats.size()) / kSplatValues; }
  int tile() const { return int(ranges.size()) - 1; }  // the one that is being filled

  // x, y: in the tile.
  void add(float x, float y, float inverse_width, float log2_opacity) {
    instances.push_back(int32_t(count()));
    slots.push_back(gs::SplatSlots{count(), tile(), 1});
    const auto color = [] { return float(std::uniform_real_distribution<>()(generator)); };
    for (const float value : {x + float(kTile * tile()), y, inverse_width, 0.1f * inverse_width, inverse_width,
                              log2_opacity, color(), color(), color(), color()})
      splats.push_back(value);
  }
  void add_faint(float log2_opacity) {
    const auto at = [] { return float(std::uniform_real_distribution<>(0, kTile)(generator)); };
    add(at(), at(), 0.05f, log2_opacity + 0.3f * float(normal()));
  }
  void end_tile() { ranges.push_back(int64_t(instances.size())); }
};

struct Blending {
  std::vector<float> color, transmittance, depth, moments, absolute;
  std::vector<int32_t> last;
};

// depth, last: whether these outputs are asked for; without depth the backward gives lengths of absolute gradients.
// layers: whether the forward gives its layers to the backward.
template <class Where>
Blending blend_lists(const Where& where, const LongLists& lists, bool depth, bool last, bool layers) {
  using gs::cuda::blend, gs::cuda::blend_vjp, gs::GS_ISA::blend, gs::GS_ISA::blend_vjp;
  const float background[3] = {0.1f, 0.2f, 0.3f};
  const size_t pixels = size_t(lists.image.width) * lists.image.height;
  const int64_t total = int64_t(lists.instances.size());
  Blending out;
  out.color.resize(3 * pixels), out.transmittance.resize(pixels);
  out.depth.resize(depth ? pixels : 0), out.last.resize(last ? pixels : 0);
  std::vector<float> made(layers ? layer_values(lists.image, total, depth) : 0, NAN);
  float* const to = layers ? made.data() : nullptr;
  const gs::BlendInput<float> in = {
      lists.splats.data(), lists.instances.data(), lists.ranges.data(), background, lists.image, total};
  blend(where, in,
        gs::Blended<float>{out.color.data(), out.transmittance.data(), depth ? out.depth.data() : nullptr,
                           last ? out.last.data() : nullptr, to});
  if (!last) return out;
  std::vector<gs::SplatSlots> slots = lists.slots;
  slots.push_back({lists.count(), 0, 0});
  std::vector<float> gradients;
  std::mt19937 numbers(8);
  for (size_t i = 0; i < 5 * pixels; ++i) gradients.push_back(float(std::normal_distribution<>()(numbers)));
  const float* g = gradients.data();
  out.moments.resize(kGradientValues * lists.count()), out.absolute.resize(depth ? 0 : lists.count());
  blend_vjp(where, in,
            gs::BlendGradient<float>{lists.count(), total, lists.count(), slots.data(), out.transmittance.data(),
                                     out.last.data(), g, depth ? g + 3 * pixels : nullptr, g + 4 * pixels,
                                     out.moments.data(), to, nullptr, depth ? nullptr : out.absolute.data()});
  return out;
}
