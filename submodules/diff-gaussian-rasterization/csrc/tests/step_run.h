#pragma once
// Gaussians that take a step from a backward: by the backward itself, or from gradients in memory, as a plain optimiser
// and density control do. Both must give the same bits.
#include <vector>

#include "backend_run.h"

struct StepCase {
  bool sparse = false, guarded = false, observed = true;
  int64_t rest_columns = 45;
  bool opacities_step = true;
  float gradient = 1;  // dLoss/dcolor of a pixel in the middle; of the others 1
  gs::Penalty<float> penalty = {0, 0};
};

// Everything that a step changes.
struct Stepping {
  Parameters<float> values;
  std::vector<float> mean[6], square[6];
  std::vector<float> statistics;  // max_radii, gradient_sums, views
  int64_t stopped = 0;
  float loss = 0.5f;

  explicit Stepping(const Parameters<float>& p) : values(p) {
    for (int a = 0; a < 6; ++a) {
      for (size_t k = 0; k < values.all()[a]->size(); ++k)
        mean[a].push_back(float(0.1 * normal())), square[a].push_back(float(std::abs(normal()) + 1e-3));
    }
    for (int64_t k = 0; k < 3 * p.count; ++k) statistics.push_back(float(std::abs(normal())));
  }

  // Adam's inputs in the order of gs::Stepped; `gradients` may be null.
  void inputs(const StepCase& how, const float* const* gradients, gs::AdamInput<float>* to) {
    constexpr int64_t kRows[6] = {3, 1, 3, 4, 3, 45};
    for (int a = 0; a < 6; ++a) {
      int64_t columns = a == gs::kStepShRest ? how.rest_columns : kRows[a];
      if (a == gs::kStepOpacities && !how.opacities_step) columns = 0;
      to[a] = {values.all()[a]->data(),
               gradients ? gradients[a] : nullptr,
               mean[a].data(),
               square[a].data(),
               values.count,
               kRows[a],
               columns,
               0.01 * (a + 1),
               0.9,
               0.999,
               1e-15,
               double(a + 3)};
    }
  }
  gs::ObserveInput observe(const StepCase& how, const int32_t* radii, const float* gradients) {
    const int64_t n = values.count;
    float* s = how.observed ? statistics.data() : nullptr;
    return {n, s, s ? s + n : nullptr, s ? s + 2 * n : nullptr, radii, gradients};
  }
  gs::StepGuard<float> guard(const StepCase& how, int64_t iteration) {
    return how.guarded ? gs::StepGuard<float>{&loss, &stopped, iteration} : gs::StepGuard<float>{};
  }

  std::vector<uint8_t> bytes() {
    std::vector<uint8_t> all;
    const auto add = [&](const std::vector<float>& part) {
      const auto* from = reinterpret_cast<const uint8_t*>(part.data());
      all.insert(all.end(), from, from + part.size() * sizeof(float));
    };
    for (int a = 0; a < 6; ++a) add(*values.all()[a]), add(mean[a]), add(square[a]);
    add(statistics);
    all.push_back(uint8_t(stopped));
    return all;
  }
};

// A forward whose gradient is 1 but for one pixel in the middle.
template <class Where>
std::unique_ptr<Rendered> render_with(const Where& where, const gs::Scene<float>& scene, float gradient) {
  auto out = render(where, scene);
  out->gradient[out->pixels() / 2 + scene.image.width / 2] = gradient;
  return out;
}

// Takes an iteration's step from gradients in memory. fill writes them, from the render.
template <class Where, class Fill>
void step_plainly(const Where& where, Stepping& s, const StepCase& how, const Rendered& r, int64_t iteration,
                  const Fill& fill) {
  using gs::observe, gs::cuda::adam, gs::cuda::sparse_adam;
  using gs::cuda::penalise;
  using gs::GS_ISA::adam, gs::GS_ISA::penalise, gs::GS_ISA::sparse_adam;
  GradientsInMemory<float> gradient(s.values.count);
  const gs::SceneGradient<float>& g = gradient.pointers;
  fill(g);
  if (how.observed) observe(where, s.observe(how, r.radii.data(), g.means2d));
  if (how.penalty.any())
    penalise(where, gs::PenaltyInput<float>{s.values.count, how.penalty, s.values.opacities.data(),
                                            s.values.scales.data(), g.opacities, g.scales});
  const float* const by_attribute[6] = {g.means, g.opacities, g.scales, g.rotations, g.sh_dc, g.sh_rest};
  gs::AdamInput<float> inputs[6];
  s.inputs(how, by_attribute, inputs);
  const auto visible = std::make_unique<bool[]>(s.values.count);
  for (int64_t i = 0; i < s.values.count; ++i) visible[i] = r.radii[i] > 0;
  if (!how.sparse) return adam(where, inputs, 6, s.guard(how, iteration));
  for (gs::AdamInput<float>& in : inputs) {
    in.step = 0;  // without bias correction
    sparse_adam(where, in, visible.get(), s.guard(how, iteration));
  }
}

inline gs::GaussianStep<float> gaussian_step(Stepping& s, const StepCase& how, const Rendered& r, int64_t iteration) {
  gs::GaussianStep<float> step{};
  s.inputs(how, nullptr, step.attributes);
  step.guard = s.guard(how, iteration);
  step.sparse = how.sparse;
  step.observed = s.observe(how, r.radii.data(), nullptr);
  step.penalty = how.penalty;
  return step;
}

inline const StepCase kStepCases[] = {
    {},
    {true},
    {false, true},
    {true, true},
    {false, true, false, 45, true, NAN},
    {true, true, true, 45, true, NAN},
    {false, false, true, 45, true, NAN},
    {false, false, true, 9, true},
    {true, false, true, 24, true},
    {false, true, false, 0, false},
    {false, true, true, 45, true, 1, {0.3f, 0.2f}},
    {true, false, true, 45, true, 1, {0.3f, 0}},
    {false, false, false, 9, false, 1, {0.3f, 0.2f}},
};
