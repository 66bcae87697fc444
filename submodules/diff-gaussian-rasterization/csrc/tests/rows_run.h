#pragma once
// Gradient rows of a rendering, of the whole image at once or of bands of tile rows one after the other.
#include <algorithm>
#include <vector>

#include "step_run.h"

struct KeptRows {
  std::vector<float> rows;
  std::vector<int32_t> counts;
  int values;  // of a row

  gs::SplatRows<float> given(const Rendered& r) const {
    return {int64_t(counts.size()), r.tile_counts.data(), counts.data(), rows.data(), int64_t(rows.size()) / values};
  }
};

template <class Where>
KeptRows keep_rows(const Where& where, const gs::BlendInput<float>& in, const gs::BlendGradient<float>& g,
                   bool absolute) {
  using gs::cuda::blend_rows, gs::GS_ISA::blend_rows;
  KeptRows out{{}, std::vector<int32_t>(g.count, -77), kGradientValues + (absolute ? 2 : 0)};
  const auto take = [](void* context, int64_t count) {
    KeptRows& to = *static_cast<KeptRows*>(context);
    to.rows.assign(size_t(count) * to.values, NAN);
    return to.rows.data();
  };
  blend_rows(where, in, g, gs::RowMemory<float>{take, &out, out.counts.data(), absolute});
  CHECK(int64_t(out.rows.size()) / out.values == std::accumulate(out.counts.begin(), out.counts.end(), int64_t(0)));
  return out;
}

// A band's own forward and rows: tile rows `top` to `bottom` keep their lists, the others' are empty. The planes of r
// must be those of the whole image.
template <class Where>
KeptRows rows_of_band(const Where& where, const Rendered& r, int top, int bottom, bool absolute) {
  using gs::cuda::blend, gs::GS_ISA::blend;
  const gs::Image image = r.scene.image;
  const int across = (image.width + 15) / 16;
  std::vector<int64_t> ranges = r.ranges;
  for (int64_t& begin : ranges) begin = std::clamp(begin, r.ranges[top * across], r.ranges[bottom * across]);
  const size_t pixels = size_t(image.width) * image.height;
  std::vector<float> color(3 * pixels), transmittance(pixels), depth(pixels);
  std::vector<int32_t> last(pixels);
  std::vector<float> layers = memory_for_layers<float>(where, image, r.input.instance_count);
  gs::BlendInput<float> in = r.input;
  in.ranges = ranges.data();
  const bool made = r.backward.layers;
  blend(where, in,
        gs::Blended<float>{color.data(), transmittance.data(), depth.data(), last.data(),
                           made ? layers.data() : nullptr});
  for (size_t pixel = size_t(16 * top) * image.width; pixel < pixels && pixel < size_t(16 * bottom) * image.width;
       ++pixel) {
    for (int c = 0; c < 3; ++c) CHECK(color[c * pixels + pixel] == r.color[c * pixels + pixel]);
    CHECK(transmittance[pixel] == r.transmittance[pixel] && depth[pixel] == r.inverse_depth[pixel]);
    CHECK(last[pixel] == r.last[pixel]);
  }
  gs::BlendGradient<float> g = r.backward;
  g.transmittance = transmittance.data(), g.last = last.data(), g.layers = made ? layers.data() : nullptr;
  return keep_rows(where, in, g, absolute);
}

// The rows of all bands of `high` tile rows, those of a splat in the order of the bands.
template <class Where>
KeptRows rows_by_bands(const Where& where, const Rendered& r, int high, bool absolute) {
  const int down = (r.scene.image.height + 15) / 16;
  std::vector<KeptRows> bands;
  for (int top = 0; top < down; top += high)
    bands.push_back(rows_of_band(where, r, top, std::min(top + high, down), absolute));
  KeptRows out{{}, std::vector<int32_t>(r.scene.count, 0), bands[0].values};
  std::vector<size_t> taken(bands.size(), 0);
  for (int64_t i = 0; i < r.scene.count; ++i)
    for (size_t b = 0; b < bands.size(); ++b) {
      const auto from = bands[b].rows.begin() + taken[b];
      const size_t values = size_t(bands[b].counts[i]) * out.values;
      out.rows.insert(out.rows.end(), from, from + values);
      out.counts[i] += bands[b].counts[i], taken[b] += values;
    }
  return out;
}

// In place of the rows of each splat, their sum.
template <class Where>
KeptRows summed(const Where& where, const KeptRows& in) {
  using gs::sum_runs, gs::cuda::sum_runs;
  KeptRows out{{}, in.counts, in.values};
  for (int32_t& count : out.counts) count = std::min(count, 1);
  const int64_t runs = in.counts.size(), room = std::accumulate(out.counts.begin(), out.counts.end(), int64_t(0));
  out.rows.assign(room * in.values, NAN);
  sum_runs(where, gs::SumInput<float>{runs, int64_t(in.rows.size()) / in.values, room, in.values, in.counts.data(),
                                      out.counts.data(), in.rows.data(), out.rows.data()});
  return out;
}

// Scenes of which splats have no rows, few or many: one lies over the whole image, and of the last scene none is seen.
inline std::vector<Parameters<float>> scenes_for_rows() {
  std::vector<Parameters<float>> scenes;
  for (const int64_t count : {0, 1, 33, 200, 40}) scenes.emplace_back(count);
  for (int k = 0; k < 3; ++k) scenes[3].scales[3 * 17 + k] = 1, scenes[3].means[3 * 17 + k] = k == 2 ? 4 : 0;
  for (int64_t i = 0; i < 40; ++i) scenes[4].means[3 * i + 2] = -4;
  return scenes;
}

// Checks the rows of bands against those of the whole image, and `gradients_of` them and of their sums against those of
// the lists.
// gradients_of(r, rows or null for the lists, lengths of absolute gradients or null): means, ..., sh_rest.
template <class Where, class GradientsOf>
void check_rows(const Where& where, const gs::Scene<float>& scene, bool depth, bool layers,
                const GradientsOf& gradients_of) {
  const auto r = render_with(where, scene, 3);
  if (!depth) r->backward.inverse_depth = r->backward.transmittance_gradient = nullptr;
  if (!layers) r->backward.layers = nullptr;
  for (const bool absolute : {false, true}) {
    const KeptRows whole = keep_rows(where, r->input, r->backward, absolute);
    for (const int high : {1, 2}) {
      const KeptRows bands = rows_by_bands(where, *r, high, absolute);
      CHECK(bands.rows == whole.rows && bands.counts == whole.counts);
    }
    std::vector<float> lengths[2];
    for (std::vector<float>& of : lengths) of.assign(absolute ? scene.count : 0, -77.0f);
    const auto to = [&](int which) { return absolute ? lengths[which].data() : nullptr; };
    const auto wanted = gradients_of(*r, static_cast<const KeptRows*>(nullptr), to(1));
    for (const KeptRows& rows : {whole, summed(where, whole)}) {
      CHECK(gradients_of(*r, &rows, to(0)) == wanted);
      CHECK(lengths[0] == lengths[1]);
    }
  }
}
