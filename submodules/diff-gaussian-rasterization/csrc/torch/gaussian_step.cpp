// The op that runs the rasterizer's backward and takes the Gaussians' steps in one.
#include <array>

#include "backward.h"
#include "math/splat.h"
#include "math/step_now.h"
#include "optim.h"
#include "scene.h"

namespace gs::ops {

namespace {

using gs::baseline::kSplatValues;

// Checks the attributes that step, their counters, and the lengths of the lists with an entry for each.
void check_steps(at::IntArrayRef attributes, at::TensorList steps, std::initializer_list<size_t> lengths) {
  const size_t n = attributes.size();
  TORCH_CHECK(steps.size() == n, "every list must have an entry for each of the ", n, " attributes, got ",
              steps.size());
  for (size_t length : lengths)
    TORCH_CHECK(length == n, "every list must have an entry for each of the ", n, " attributes, got ", length);
  std::array<bool, gs::kStepped> named{};
  for (int64_t a : attributes) {
    TORCH_CHECK(a >= 0 && a < gs::kStepped && !named[a], "attributes must be different numbers from 0 to ",
                gs::kStepped - 1, ", got ", attributes);
    named[a] = true;
  }
  for (const Tensor& step : steps) check_counter(step);
}

// Advances the counters of steps.
void advance(at::TensorList steps) {
  for (const Tensor& step : steps) *step.mutable_data_ptr<float>() += 1;
}

// Adam's lists, with an entry for each attribute that `attributes` names by its place in gs::Stepped.
struct StepLists {
  at::IntArrayRef attributes;
  at::TensorList exp_avg, exp_avg_sq, steps;
  at::ArrayRef<double> rates;
  at::IntArrayRef columns;
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
    in.step = double(*lists.steps[k].const_data_ptr<float>()) + 1;
    out.attributes[lists.attributes[k]] = in;
  }
  return out;
}

// Owns the radii, and adds the statistics to a step, if they are given.
template <class T>
void observe_in(gs::GaussianStep<T>& step, const Tensor& radii, const MaybeTensor& max_radii,
                const MaybeTensor& gradient_sums, const MaybeTensor& views) {
  step.observed = {radii.numel(), nullptr, nullptr, nullptr, radii.const_data_ptr<int32_t>(), nullptr};
  const bool given = max_radii.has_value();
  TORCH_CHECK(gradient_sums.has_value() == given && views.has_value() == given,
              "give max_radii, gradient_sums and views, or none of them");
  if (!given) return;
  check_statistics(*max_radii, *gradient_sums, *views, radii);
  TORCH_CHECK((std::is_same_v<T, float>), "statistics are of float32 Gaussians, got float64");
  step.observed.max_radii = max_radii->mutable_data_ptr<float>();
  step.observed.gradient_sums = gradient_sums->mutable_data_ptr<float>();
  step.observed.views = views->mutable_data_ptr<float>();
}

// The numbers of a step that was recorded before; null for those of the call.
const gs::StepNow* step_now(const MaybeTensor& now, const SceneTensors& scene) {
  if (!now) return nullptr;
  check_tensor(*now, "now", at::kLong, scene.device(), {gs::kStepNowWords});
  TORCH_CHECK_VALUE(now->is_contiguous(), "now must be contiguous");
  TORCH_CHECK(scene.dtype() == at::kFloat, "now is of float32 Gaussians, got float64");
  return reinterpret_cast<const gs::StepNow*>(now->const_data_ptr<int64_t>());
}

// absolute: receives the lengths of absolute gradients, if it is defined; then they are what is observed.
void run(const SceneTensors& scene, const BlendBackward& in, const Tensor& tile_counts, const Tensor& /*absolute*/,
         const gs::GaussianStep<double>& step) {
  const Tensor moments = blend_vjp(in);
  GS_DISPATCH(project_vjp_step, gs::torch_executor(), scene.scene<double>(), tile_counts.const_data_ptr<int32_t>(),
              moments.const_data_ptr<double>(), step);
}

void run(const SceneTensors& scene, const BlendBackward& in, const Tensor& tile_counts, const Tensor& absolute,
         gs::GaussianStep<float> step) {
  gs::ObserveInput later = step.observed;
  if (absolute.defined()) later.lengths = absolute.const_data_ptr<float>(), step.observed.max_radii = nullptr;
#ifdef GS_CUDA
  if (in.splats().is_cuda()) {
    gs::TorchQueue queue(in.splats().device(), halted());
    gs::cuda::rasterize_vjp_step(queue.queue(), scene.scene<float>(), in.input<float>(),
                                 in.gradient<float>(nullptr, absolute), step);
    if (later.lengths) gs::cuda::observe(queue.queue(), later);
    return;
  }
#endif
  const Tensor moments = blend_vjp(in, absolute);
  GS_DISPATCH(project_vjp_step, gs::torch_executor(), scene.scene<float>(), tile_counts.const_data_ptr<int32_t>(),
              moments.const_data_ptr<float>(), step);
  if (later.lengths) gs::observe(gs::torch_executor(), later);
}

// rasterize_vjp, penalise_ unless both penalties are 0, then adam_ (or sparse_adam_ on the Gaussians of a radius above
// 0) of the attributes that are named, and observe_ if statistics are given: the same bits, without gradients in
// memory. Advances the counters as adam_ does. now: what `step_now_` wrote, which stands in for steps, rates and
// iteration, and has advanced the counters. absolute: the statistics get the lengths of absolute gradients.
void rasterize_vjp_step_op(SCENE_PARAMETERS, BACKWARD_PARAMETERS, const Tensor& tile_counts, const Tensor& layers,
                           const Tensor& radii, at::IntArrayRef attributes, at::TensorList exp_avg,
                           at::TensorList exp_avg_sq, at::TensorList steps, at::ArrayRef<double> rates, double beta1,
                           double beta2, double eps, at::IntArrayRef columns, bool sparse, const MaybeTensor& max_radii,
                           const MaybeTensor& gradient_sums, const MaybeTensor& views, const MaybeTensor& loss,
                           const MaybeTensor& stopped, int64_t iteration, const MaybeTensor& now, bool absolute,
                           double opacity_penalty, double scale_penalty) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  TORCH_CHECK_VALUE(!cov3d && !colors, "a step needs scales, rotations, sh_dc and sh_rest, not cov3d or colors");
  check_tensor(splats, "splats", scene.dtype(), scene.device(), {scene.count(), kSplatValues});
  check_counts(tile_counts, scene.count(), scene.device());
  check_tensor(radii, "radii", at::kInt, scene.device(), {scene.count()});
  BlendBackward in(BACKWARD_ARGUMENTS);
  in.take_layers(layers);
  const StepLists lists{attributes, exp_avg, exp_avg_sq, steps, rates, columns, beta1, beta2, eps};
  lists.check();
  const bool penalised = opacity_penalty != 0 || scale_penalty != 0;
  TORCH_CHECK_VALUE(!penalised || raw, "penalties are of raw Gaussians");
  const Tensor counts = tile_counts.contiguous(), pixels = radii.contiguous();
  const Tensor lengths = absolute_like(splats, absolute && max_radii);
  with_scalar(scene.dtype(), [&](auto zero) {
    using T = decltype(zero);
    auto step = gaussian_step<T>({means, opacities, *scales, *rotations, *sh_dc, *sh_rest}, lists, sparse);
    step.guard = step_guard<T>(means, loss, stopped, iteration);
    observe_in(step, pixels, max_radii, gradient_sums, views);
    step.now = step_now(now, scene);
    step.penalty = {T(opacity_penalty), T(scale_penalty)};
    run(scene, in, counts, lengths, step);
  });
  if (!now) advance(steps);
}

// Writes what the next step stands for, and advances the counters.
void step_now_op(Tensor& now, at::IntArrayRef attributes, at::TensorList steps, at::ArrayRef<double> rates,
                 double beta1, double beta2, double eps, bool sparse, int64_t iteration) {
  check_tensor(now, "now", at::kLong, at::kCPU, {gs::kStepNowWords});
  TORCH_CHECK_VALUE(now.is_contiguous(), "now must be contiguous");
  check_steps(attributes, steps, {rates.size()});
  auto* to = reinterpret_cast<gs::StepNow*>(now.mutable_data_ptr<int64_t>());
  for (size_t k = 0; k < attributes.size(); ++k)
    gs::set_constants(
        *to, attributes[k],
        gs::step_constants(sparse, rates[k], beta1, beta2, eps, double(*steps[k].const_data_ptr<float>()) + 1));
  to->iteration = iteration;
  advance(steps);
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(diff_gaussian_rasterization, m) {
  // The values of the Gaussians are read, and stepped in place.
  std::string scene = SCENE_SCHEMA;
  char alias = 'a';
  for (const char* name : {"means", "opacities", "scales", "rotations", "sh_dc", "sh_rest"}) {
    const size_t type = scene.rfind("Tensor", scene.find(std::string(" ") + name + ","));
    scene.insert(type + 6, std::string("(") + alias++ + "!)");
  }
  define(m,
         "rasterize_vjp_step_(" + scene +
             ", " BACKWARD_SCHEMA
             ", Tensor tile_counts, Tensor layers, Tensor radii, int[] attributes, Tensor(g!)[] exp_avg, Tensor(h!)[] "
             "exp_avg_sq, "
             "Tensor(i!)[] steps, float[] rates, float beta1, float beta2, float eps, int[] columns, bool sparse, "
             "Tensor(j!)? max_radii=None, Tensor(k!)? gradient_sums=None, Tensor(l!)? views=None, Tensor? loss=None, "
             "Tensor(m!)? stopped=None, int iteration=0, Tensor? now=None, bool absolute=False, "
             "float opacity_penalty=0, float scale_penalty=0) -> ()",
         &rasterize_vjp_step_op);
  define(m,
         "step_now_(Tensor(a!) now, int[] attributes, Tensor(b!)[] steps, float[] rates, float beta1, float beta2, "
         "float eps, bool sparse, int iteration) -> ()",
         &step_now_op);
}

}  // namespace gs::ops
