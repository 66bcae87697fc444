#pragma once
// Gradient rows of a rendering.
#include <algorithm>
#include <vector>

#include "step_run.h"

struct KeptRows {
  std::vector<float> rows;
  std::vector<int32_t> counts;
  int values;  // of a row

  gs::SplatRows<float> given(const Rendered& r) const {
    return {int64_t(counts.size()),        r.tile_counts.data(), counts.data(), rows.data(),
            int64_t(rows.size()) / values, r.scene.rays()};
  }
};

template <class Where>
KeptRows keep_rows(const Where& where, const gs::BlendInput<float>& in, const gs::BlendGradient<float>& g,
                   bool absolute) {
  using gs::cuda::blend_rows, gs::GS_ISA::blend_rows;
  KeptRows out{{}, std::vector<int32_t>(g.count, -77), gradient_row(in.rays) + (absolute ? 2 : 0)};
  const auto take = [](void* context, int64_t count) {
    KeptRows& to = *static_cast<KeptRows*>(context);
    to.rows.assign(size_t(count) * to.values, NAN);
    return to.rows.data();
  };
  blend_rows(where, in, g, gs::RowMemory<float>{take, &out, out.counts.data(), absolute});
  CHECK(int64_t(out.rows.size()) / out.values == std::accumulate(out.counts.begin(), out.counts.end(), int64_t(0)));
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

// Checks `gradients_of` rows and of their sums against those of the lists.
// gradients_of(r, rows or null for the lists, lengths of absolute gradients or null): means, ..., sh_rest.
template <class Where, class GradientsOf>
void check_rows(const Where& where, const gs::Scene<float>& scene, bool depth, bool layers,
                const GradientsOf& gradients_of) {
  const auto r = render_with(where, scene, 3);
  if (!depth) r->backward.inverse_depth = r->backward.transmittance_gradient = nullptr;
  if (!layers) r->backward.layers = nullptr;
  for (const bool absolute : {false, true}) {
    const KeptRows whole = keep_rows(where, r->input, r->backward, absolute);
    std::vector<float> lengths[2];
    for (std::vector<float>& of : lengths) of.assign(absolute ? scene.count : 0, -77.0f);
    const auto to = [&](int which) { return absolute ? lengths[which].data() : nullptr; };
    const auto wanted = gradients_of(*r, static_cast<const KeptRows*>(nullptr), to(1));
    for (const KeptRows& rows : {whole, scene.on_rays ? whole : summed(where, whole)}) {
      CHECK(gradients_of(*r, &rows, to(0)) == wanted);
      CHECK(lengths[0] == lengths[1]);
    }
  }
}
