// The ops that run the rasterizer's backward and take the Gaussians' steps in one.
#include <array>

#include "gradient_source.h"
#include "math/step_now.h"
#include "optim.h"

namespace gs::ops {

namespace {

// Checks the attributes that step, their counters, and the lengths of the lists with an entry for each.
void check_steps(Sizes attributes, List<Tensor> steps, std::initializer_list<size_t> lengths) {
  const size_t n = attributes.size();
  GS_CHECK(steps.size() == n, "every list must have an entry for each of the ", n, " attributes, got ", steps.size());
  for (size_t length : lengths)
    GS_CHECK(length == n, "every list must have an entry for each of the ", n, " attributes, got ", length);
  std::array<bool, gs::kStepped> named{};
  for (int64_t a : attributes) {
    GS_CHECK(a >= 0 && a < gs::kStepped && !named[a], "attributes must be different numbers from 0 to ",
             gs::kStepped - 1, ", got ", attributes);
    named[a] = true;
  }
  for (const Tensor& step : steps) check_counter(step);
}

// Advances the counters of steps.
void advance(List<Tensor> steps) {
  for (const Tensor& step : steps) *write<float>(step) += 1;
}

// Adam's lists, with an entry for each attribute that `attributes` names by its place in gs::Stepped.
struct StepLists {
  Sizes attributes;
  List<Tensor> exp_avg, exp_avg_sq, steps;
  List<double> rates;
  Sizes columns;
  double beta1, beta2, eps;

  void check() const {
    check_steps(attributes, steps, {exp_avg.size(), exp_avg_sq.size(), rates.size(), columns.size()});
  }
};

using Values = std::array<Tensor, gs::kStepped>;

template <class T>
gs::GaussianStep<T> gaussian_step(const Values& values, const StepLists& lists, bool sparse) {
  gs::GaussianStep<T> out{};
  out.sparse = sparse;
  for (size_t k = 0; k < lists.attributes.size(); ++k) {
    const Tensor& value = values[lists.attributes[k]];
    check_moments(value, value, lists.exp_avg[k], lists.exp_avg_sq[k]);
    gs::AdamInput<T> in = adam_input<T>(value, value, lists.exp_avg[k], lists.exp_avg_sq[k], lists.columns[k]);
    in.lr = lists.rates[k], in.beta1 = lists.beta1, in.beta2 = lists.beta2, in.eps = lists.eps;
    in.step = double(*read<float>(lists.steps[k])) + 1;
    out.attributes[lists.attributes[k]] = in;
  }
  return out;
}

// Owns the radii, and adds the statistics to a step, if they are given.
template <class T>
void observe_in(gs::GaussianStep<T>& step, const Tensor& radii, const MaybeTensor& max_radii,
                const MaybeTensor& gradient_sums, const MaybeTensor& views) {
  step.observed = {radii.numel(), nullptr, nullptr, nullptr, read<int32_t>(radii), nullptr};
  const bool given = max_radii.has_value();
  GS_CHECK(gradient_sums.has_value() == given && views.has_value() == given,
           "give max_radii, gradient_sums and views, or none of them");
  if (!given) return;
  check_statistics(*max_radii, *gradient_sums, *views, radii);
  GS_CHECK((std::is_same_v<T, float>), "statistics are of float32 Gaussians, got float64");
  step.observed.max_radii = write<float>(*max_radii);
  step.observed.gradient_sums = write<float>(*gradient_sums);
  step.observed.views = write<float>(*views);
}

// The numbers of a step that was recorded before; null for those of the call.
const gs::StepNow* step_now(const MaybeTensor& now, const SceneTensors& scene) {
  if (!now) return nullptr;
  check_tensor(*now, "now", ScalarType::Long, scene.device(), {gs::kStepNowWords});
  GS_CHECK_VALUE(now->is_contiguous(), "now must be contiguous");
  GS_CHECK(scene.dtype() == ScalarType::Float, "now is of float32 Gaussians, got float64");
  return reinterpret_cast<const gs::StepNow*>(read<int64_t>(*now));
}

// source: Lists or Rows. lengths: of absolute gradients, if it is defined; then they are what is observed.
template <class Source>
void run(const SceneTensors& scene, const Source& source, const Tensor& /*lengths*/,
         const gs::GaussianStep<double>& step) {
  const Tensor moments = source.moments({});
  GS_DISPATCH(project_vjp_step, gs::torch_executor(), scene.scene<double>(), read<int32_t>(source.tile_counts()),
              read<double>(moments), step);
}

template <class Source>
void run(const SceneTensors& scene, const Source& source, const Tensor& lengths, gs::GaussianStep<float> step) {
  gs::ObserveInput later = step.observed;
  if (lengths.defined()) later.lengths = read<float>(lengths), step.observed.max_radii = nullptr;
#ifdef GS_CUDA
  if (scene.device().is_cuda()) {
    gs::TorchQueue queue(scene.device(), halted());
    source.step(queue.queue(), scene.scene<float>(), lengths, step);
    if (later.lengths) gs::cuda::observe(queue.queue(), later);
    return;
  }
#endif
  const Tensor moments = source.moments(lengths);
  GS_DISPATCH(project_vjp_step, gs::torch_executor(), scene.scene<float>(), read<int32_t>(source.tile_counts()),
              read<float>(moments), step);
  if (later.lengths) gs::observe(gs::torch_executor(), later);
}

#define STEP_SCHEMA                                                                                              \
  "Tensor radii, int[] attributes, Tensor(g!)[] exp_avg, Tensor(h!)[] exp_avg_sq, Tensor(i!)[] steps, "          \
  "float[] rates, float beta1, float beta2, float eps, int[] columns, bool sparse, Tensor(j!)? max_radii=None, " \
  "Tensor(k!)? gradient_sums=None, Tensor(l!)? views=None, Tensor? loss=None, Tensor(m!)? stopped=None, "        \
  "int iteration=0, Tensor? now=None, bool absolute=False, float opacity_penalty=0, float scale_penalty=0"
#define STEP_PARAMETERS                                                                                              \
  const Tensor &radii, Sizes attributes, List<Tensor> exp_avg, List<Tensor> exp_avg_sq, List<Tensor> steps,          \
      List<double> rates, double beta1, double beta2, double eps, Sizes columns, bool sparse,                        \
      const MaybeTensor &max_radii, const MaybeTensor &gradient_sums, const MaybeTensor &views,                      \
      const MaybeTensor &loss, const MaybeTensor &stopped, int64_t iteration, const MaybeTensor &now, bool absolute, \
      double opacity_penalty, double scale_penalty
#define STEP_ARGUMENTS                                                                                                \
  radii, attributes, exp_avg, exp_avg_sq, steps, rates, beta1, beta2, eps, columns, sparse, max_radii, gradient_sums, \
      views, loss, stopped, iteration, now, absolute, opacity_penalty, scale_penalty

// Takes the step of the Gaussians whose gradients come from what `source_of` makes of the scene.
template <class SourceOf>
void step_from(const SourceOf& source_of, SCENE_PARAMETERS, STEP_PARAMETERS) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  GS_CHECK_VALUE(!cov3d && !colors, "a step needs scales, rotations, sh_dc and sh_rest, not cov3d or colors");
  check_tensor(radii, "radii", ScalarType::Int, scene.device(), {scene.count()});
  const auto source = source_of(scene);
  const StepLists lists{attributes, exp_avg, exp_avg_sq, steps, rates, columns, beta1, beta2, eps};
  lists.check();
  const bool penalised = opacity_penalty != 0 || scale_penalty != 0;
  GS_CHECK_VALUE(!penalised || raw, "penalties are of raw Gaussians");
  const Tensor pixels = packed(radii), lengths = absolute_like(means, absolute && max_radii);
  with_scalar(scene.dtype(), [&](auto zero) {
    using T = decltype(zero);
    auto step = gaussian_step<T>({means, opacities, *scales, *rotations, *sh_dc, *sh_rest}, lists, sparse);
    step.guard = step_guard<T>(means, loss, stopped, iteration);
    observe_in(step, pixels, max_radii, gradient_sums, views);
    step.now = step_now(now, scene);
    step.penalty = {T(opacity_penalty), T(scale_penalty)};
    run(scene, source, lengths, step);
  });
  if (!now) advance(steps);
}

// rasterize_vjp, penalise_ unless both penalties are 0, then adam_ (or sparse_adam_ on the Gaussians of a radius above
// 0) of the attributes that are named, and observe_ if statistics are given: the same bits, without gradients in
// memory. Advances the counters as adam_ does. now: what `step_now_` wrote, which stands in for steps, rates and
// iteration, and has advanced the counters. absolute: the statistics get the lengths of absolute gradients.
void rasterize_vjp_step_op(SCENE_PARAMETERS, LISTS_PARAMETERS, STEP_PARAMETERS) {
  const auto lists = [&](const SceneTensors& scene) { return Lists(scene, LISTS_ARGUMENTS); };
  step_from(lists, SCENE_ARGUMENTS, STEP_ARGUMENTS);
}

// The same from the rows of blend_rows, as rows_vjp takes them.
void rows_vjp_step_op(SCENE_PARAMETERS, ROWS_PARAMETERS, STEP_PARAMETERS) {
  const auto given = [&](const SceneTensors& scene) {
    return Rows(scene, ROWS_ARGUMENTS, absolute, absolute && max_radii);
  };
  step_from(given, SCENE_ARGUMENTS, STEP_ARGUMENTS);
}

// Writes what the next step stands for, and advances the counters.
void step_now_op(Tensor& now, Sizes attributes, List<Tensor> steps, List<double> rates, double beta1, double beta2,
                 double eps, bool sparse, int64_t iteration) {
  check_tensor(now, "now", ScalarType::Long, DeviceType::CPU, {gs::kStepNowWords});
  GS_CHECK_VALUE(now.is_contiguous(), "now must be contiguous");
  check_steps(attributes, steps, {rates.size()});
  auto* to = reinterpret_cast<gs::StepNow*>(write<int64_t>(now));
  for (size_t k = 0; k < attributes.size(); ++k)
    gs::set_constants(*to, attributes[k],
                      gs::step_constants(sparse, rates[k], beta1, beta2, eps, double(*read<float>(steps[k])) + 1));
  to->iteration = iteration;
  advance(steps);
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  // The values of the Gaussians are read, and stepped in place.
  std::string scene = SCENE_SCHEMA;
  char alias = 'a';
  for (const char* name : {"means", "opacities", "scales", "rotations", "sh_dc", "sh_rest"}) {
    const size_t type = scene.rfind("Tensor", scene.find(std::string(" ") + name + ","));
    scene.insert(type + 6, std::string("(") + alias++ + "!)");
  }
  m.define("rasterize_vjp_step_(" + scene + ", " LISTS_SCHEMA ", " STEP_SCHEMA ") -> ()",
           TORCH_BOX(&rasterize_vjp_step_op));
  m.define("rows_vjp_step_(" + scene + ", " ROWS_SCHEMA ", " STEP_SCHEMA ") -> ()", TORCH_BOX(&rows_vjp_step_op));
  m.define(
      "step_now_(Tensor(a!) now, int[] attributes, Tensor(b!)[] steps, float[] rates, float beta1, float beta2, "
      "float eps, bool sparse, int iteration) -> ()",
      TORCH_BOX(&step_now_op));
}

}  // namespace gs::ops
