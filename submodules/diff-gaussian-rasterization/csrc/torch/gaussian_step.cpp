// The op that runs the rasterizer's backward and takes the Gaussians' steps in one.
#include <array>
#include <limits>

#include "backward.h"
#include "lazy_rows.h"
#include "math/lazy_rows.h"
#include "math/splat.h"
#include "scene.h"

namespace gs::ops {

namespace {

using gs::baseline::kSplatValues;

// Adam's lists, with an entry for each attribute that `attributes` names by its place in gs::Stepped.
struct StepLists {
  at::IntArrayRef attributes;
  at::TensorList exp_avg, exp_avg_sq, steps;
  at::ArrayRef<double> rates;
  at::IntArrayRef columns;
  double beta1, beta2, eps;

  void check() const {
    const size_t n = attributes.size();
    for (size_t size : {exp_avg.size(), exp_avg_sq.size(), steps.size(), rates.size(), columns.size()})
      TORCH_CHECK(size == n, "every list must have an entry for each of the ", n, " attributes, got ", size);
    std::array<bool, gs::kStepped> named{};
    for (int64_t a : attributes) {
      TORCH_CHECK(a >= 0 && a < gs::kStepped && !named[a], "attributes must be different numbers from 0 to ",
                  gs::kStepped - 1, ", got ", attributes);
      named[a] = true;
    }
    for (const Tensor& step : steps) check_counter(step);
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

// Lets the rows of SH coefficients that the view does not see wait, if tensors for that are given.
template <class T>
void let_wait(gs::GaussianStep<T>& step, const SceneTensors& scene, const Tensor& like, const MaybeTensor& last,
              const MaybeTensor& ring, const MaybeTensor& taken, int64_t number) {
  TORCH_CHECK(ring.has_value() == last.has_value() && taken.has_value() == last.has_value(),
              "give last, ring and taken, or none of them");
  if (!last) return;
  TORCH_CHECK(!step.sparse, "rows wait only for the dense optimiser");
  TORCH_CHECK(0 < number && number < std::numeric_limits<int32_t>::max(), "steps count from 1, got ", number);
  for (int a = gs::kFirstLazy; a < gs::kStepped; ++a) {
    const gs::AdamInput<T>& in = step.attributes[a];
    TORCH_CHECK(a == gs::kStepShRest || in.columns == 3 || !scene.count(), "rows that wait need steps of sh_dc");
    TORCH_CHECK(!in.columns || gs::baseline::may_wait(in.lr, in.beta1, in.beta2, in.eps),
                "rows cannot wait with the rate ", in.lr, ", betas ", in.beta1, " and ", in.beta2, ", eps ", in.eps);
  }
  step.lazy = lazy_rows<T>(scene.count(), like, *last, *ring, *taken);
  step.number = int32_t(number);
}

void run(const SceneTensors& scene, const BlendBackward& in, const Tensor& tile_counts,
         const gs::GaussianStep<double>& step) {
  const Tensor moments = blend_vjp(in);
  GS_DISPATCH(project_vjp_step, gs::torch_executor(), scene.scene<double>(), tile_counts.const_data_ptr<int32_t>(),
              moments.const_data_ptr<double>(), step);
}

void run(const SceneTensors& scene, const BlendBackward& in, const Tensor& tile_counts,
         const gs::GaussianStep<float>& step) {
#ifdef GS_CUDA
  if (in.splats().is_cuda()) {
    gs::TorchQueue queue(in.splats().device(), halted());
    return gs::cuda::rasterize_vjp_step(queue.queue(), scene.scene<float>(), in.input<float>(),
                                        in.gradient<float>(nullptr), step);
  }
#endif
  const Tensor moments = blend_vjp(in);
  GS_DISPATCH(project_vjp_step, gs::torch_executor(), scene.scene<float>(), tile_counts.const_data_ptr<int32_t>(),
              moments.const_data_ptr<float>(), step);
}

// rasterize_vjp, then adam_ (or sparse_adam_ on the Gaussians of a radius above 0) of the attributes that are named,
// and observe_ if statistics are given: the same bits, without gradients in memory. Advances the counters as adam_
// does. With last_steps, SH coefficients that the view does not see take their steps later, in catch_up_.
void rasterize_vjp_step_op(SCENE_PARAMETERS, BACKWARD_PARAMETERS, const Tensor& tile_counts, const Tensor& radii,
                           at::IntArrayRef attributes, at::TensorList exp_avg, at::TensorList exp_avg_sq,
                           at::TensorList steps, at::ArrayRef<double> rates, double beta1, double beta2, double eps,
                           at::IntArrayRef columns, bool sparse, const MaybeTensor& max_radii,
                           const MaybeTensor& gradient_sums, const MaybeTensor& views, const MaybeTensor& loss,
                           const MaybeTensor& stopped, int64_t iteration, const MaybeTensor& last_steps,
                           const MaybeTensor& ring, const MaybeTensor& taken, int64_t number) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  TORCH_CHECK_VALUE(!cov3d && !colors, "a step needs scales, rotations, sh_dc and sh_rest, not cov3d or colors");
  check_tensor(splats, "splats", scene.dtype(), scene.device(), {scene.count(), kSplatValues});
  check_counts(tile_counts, scene.count(), scene.device());
  check_tensor(radii, "radii", at::kInt, scene.device(), {scene.count()});
  const BlendBackward in(BACKWARD_ARGUMENTS);
  const StepLists lists{attributes, exp_avg, exp_avg_sq, steps, rates, columns, beta1, beta2, eps};
  lists.check();
  const Tensor counts = tile_counts.contiguous(), pixels = radii.contiguous();
  with_scalar(scene.dtype(), [&](auto zero) {
    using T = decltype(zero);
    auto step = gaussian_step<T>({means, opacities, *scales, *rotations, *sh_dc, *sh_rest}, lists, sparse);
    step.guard = step_guard<T>(means, loss, stopped, iteration);
    observe_in(step, pixels, max_radii, gradient_sums, views);
    let_wait(step, scene, means, last_steps, ring, taken, number);
    run(scene, in, counts, step);
  });
  for (const Tensor& step : steps) *step.mutable_data_ptr<float>() += 1;
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
             ", Tensor tile_counts, Tensor radii, int[] attributes, Tensor(g!)[] exp_avg, Tensor(h!)[] exp_avg_sq, "
             "Tensor(i!)[] steps, float[] rates, float beta1, float beta2, float eps, int[] columns, bool sparse, "
             "Tensor(j!)? max_radii=None, Tensor(k!)? gradient_sums=None, Tensor(l!)? views=None, Tensor? loss=None, "
             "Tensor(m!)? stopped=None, int iteration=0, Tensor(n!)? last_steps=None, Tensor(o!)? ring=None, "
             "Tensor(p!)? taken=None, int number=0) -> ()",
         &rasterize_vjp_step_op);
}

}  // namespace gs::ops
