// The ops that run the rasterizer's backward and change what is there by its gradients, and that say what a recorded
// step stands for.
#include <array>

#include "backward.h"
#include "math/camera_gradient.h"
#include "math/step_now.h"
#include "optim.h"

namespace gs::ops {

namespace {

constexpr size_t kGaussians = kInputs - 1;  // tensors of the Gaussians

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

// What a step takes, in lists with an entry for each attribute that `attributes` names by its place in gs::Stepped.
// averages: exp_avg of all these, then exp_avg_sq. statistics: max_radii, gradient_sums and views, or nothing. guard:
// loss and stopped, or nothing. constants: beta1, beta2, eps, and the weights of the penalties on opacities and scales.
// camera_gradient: gets the gradients of the camera's numbers before the step (camera_vjp).
#define STEP_SCHEMA                                                                                         \
  "Tensor? radii, Tensor(c!)[] averages, Tensor(d!)[] steps, Tensor(e!)[] statistics, Tensor(f!)[] guard, " \
  "int[] attributes=[], float[] rates=[], float[] constants=[], int[] columns=[], bool sparse=False, "      \
  "int iteration=0, Tensor? now=None, bool absolute=False, Tensor(g!)? camera_gradient=None"
#define STEP_PARAMETERS                                                                                             \
  const MaybeTensor &radii, List<Tensor> averages, List<Tensor> steps, List<Tensor> statistics, List<Tensor> guard, \
      Sizes attributes, List<double> rates, List<double> constants, Sizes columns, bool sparse, int64_t iteration,  \
      const MaybeTensor &now, bool absolute, const MaybeTensor &camera_gradient
#define STEP_ARGUMENTS                                                                                                \
  radii, averages, steps, statistics, guard, attributes, rates, constants, columns, sparse, iteration, now, absolute, \
      camera_gradient

// The entry of a list that may end before it.
template <class T>
MaybeTensor entry(List<T> list, size_t place) {
  return place < list.size() ? list[place] : MaybeTensor();
}

// The parameters of a step, in the order of STEP_PARAMETERS.
struct Step {
  const MaybeTensor& radii;
  List<Tensor> averages, steps, statistics, guard;
  Sizes attributes;
  List<double> rates, constants;
  Sizes columns;
  bool sparse;
  int64_t iteration;
  const MaybeTensor& now;
  bool absolute;
  const MaybeTensor& camera_gradient;

  bool observes() const { return !statistics.empty(); }

  void check(const SceneTensors& scene) const {
    GS_CHECK_VALUE(!scene.has(kCov3d) && !scene.has(kColors),
                   "a step needs scales, rotations, sh_dc and sh_rest, not cov3d or colors");
    GS_CHECK_TYPE(radii, "radii must be a tensor, got None");
    check_tensor(*radii, "radii", ScalarType::Int, scene.device(), {scene.rows()});
    GS_CHECK(!sparse || !scene.blocks().defined(), "no block sleeps through a sparse step");
    GS_CHECK(!observes() || statistics.size() == 3, "give max_radii, gradient_sums and views, or none of them");
    GS_CHECK(!observes() || scene.dtype() == ScalarType::Float, "statistics are of float32 Gaussians, got float64");
    if (observes()) check_statistics(statistics[0], statistics[1], statistics[2], *radii, scene.count());
    if (camera_gradient) {
      check_camera_gradients(scene);
      check_tensor(*camera_gradient, "the camera's gradient", ScalarType::Double, scene.device(),
                   {baseline::kLensCameraNumbers});
      GS_CHECK_VALUE(camera_gradient->is_contiguous(), "the camera's gradient must be contiguous");
    }
    check_adam(scene);
  }

  void check_adam(const SceneTensors& scene) const {
    check_steps(attributes, steps, {rates.size(), columns.size()});
    GS_CHECK(averages.size() == 2 * steps.size(), "averages must be two for each of the ", steps.size(),
             " attributes, got ", averages.size());
    GS_CHECK_VALUE(constants.size() == 5, "constants must have 5 entries, got ", constants.size());
    GS_CHECK_VALUE((constants[3] == 0 && constants[4] == 0) || scene.raw(), "penalties are of raw Gaussians");
    if (!now) return;
    check_tensor(*now, "now", ScalarType::Long, scene.device(), {gs::kStepNowWords});
    GS_CHECK_VALUE(now->is_contiguous(), "now must be contiguous");
    GS_CHECK(scene.dtype() == ScalarType::Float, "now is of float32 Gaussians, got float64");
  }

  // What a backend takes. pixels: the radii, contiguous; those of `blocks`, if that is defined.
  template <class T>
  gs::GaussianStep<T> of(List<Tensor> gaussians, const Tensor& pixels, const Tensor& blocks = {}) const {
    constexpr int kPlaces[gs::kStepped] = {0, 1, 2, 3, 6, 7};  // of gs::Stepped, among the Gaussians' tensors
    gs::GaussianStep<T> out{};
    out.sparse = sparse;
    for (size_t k = 0; k < attributes.size(); ++k) {
      const Tensor& value = gaussians[kPlaces[attributes[k]]];
      const Tensor &mean = averages[k], &square = averages[attributes.size() + k];
      check_moments(value, value, mean, square);
      gs::AdamInput<T> in = adam_input<T>(value, value, mean, square, columns[k]);
      in.lr = rates[k], in.beta1 = constants[0], in.beta2 = constants[1], in.eps = constants[2];
      in.step = double(*read<float>(steps[k])) + 1;
      out.attributes[attributes[k]] = in;
    }
    out.guard = step_guard<T>(gaussians[0], entry(guard, 0), entry(guard, 1), iteration);
    if (now) out.now = reinterpret_cast<const gs::StepNow*>(read<int64_t>(*now));
    out.penalty = {T(constants[3]), T(constants[4])};
    if (camera_gradient) out.camera = write<double>(*camera_gradient);
    if (!pixels.defined()) return out;
    out.observed = {pixels.numel(), nullptr, nullptr, nullptr, read<int32_t>(pixels), nullptr};
    if (!observes()) return out;
    if (blocks.defined()) out.observed.blocks = read<int32_t>(blocks);
    out.observed.max_radii = write<float>(statistics[0]);
    out.observed.gradient_sums = write<float>(statistics[1]), out.observed.views = write<float>(statistics[2]);
    return out;
  }
};

// gaussians: those of Input, in its order, without means2d; an empty tensor of one axis stands for none. camera: view
// matrix, projection and centre, then which blocks are awake (SceneTensors::set_awake), unless all are.
SceneTensors scene_of(List<Tensor> gaussians, List<Tensor> camera, List<double> lens, Sizes options) {
  GS_CHECK_VALUE(gaussians.size() == kGaussians && (camera.size() == 3 || camera.size() == 4), "give ", kGaussians,
                 " tensors of the Gaussians and 3 or 4 of the camera, got ", gaussians.size(), " and ", camera.size());
  std::array<const Tensor*, kGaussians> inputs;
  for (size_t input = 0; input < inputs.size(); ++input) {
    const Tensor& t = gaussians[input];
    inputs[input] = t.defined() && t.dim() == 1 && t.size(0) == 0 && input > 1 ? nullptr : &t;
  }
  SceneTensors scene(inputs, {&camera[0], &camera[1], &camera[2]}, lens, options);
  if (camera.size() == 4) scene.set_awake(&camera[3]);
  return scene;
}

void run(const SceneTensors& scene, const GradientSource& source, const Tensor& /*lengths*/,
         const gs::GaussianStep<double>& step) {
  const Tensor moments = source.moments({});
  GS_DISPATCH(project_vjp_step, gs::torch_executor(), scene.scene<double>(), read<int32_t>(source.tile_counts()),
              read<double>(moments), step);
}

void run(const SceneTensors& scene, const GradientSource& source, const Tensor& lengths, gs::GaussianStep<float> step) {
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

// Does rasterize_vjp, penalise_ unless both penalties are 0, then adam_ (with `sparse` on the Gaussians of a radius
// above 0) of the attributes that are named, and observe_ if statistics are given: the same bits, without gradients in
// memory. Advances the counters as adam_ does. planes: the gradients of colour, transmittance and inverse depth, or
// nothing for rows. now: what `step_now_` wrote, which stands in for steps, rates and iteration, and has advanced the
// counters. absolute: the statistics get the lengths of absolute gradients. guard: loss and stopped.
void apply_gradients_op(List<Tensor> gaussians, List<Tensor> camera, List<double> lens, Sizes options,
                        List<Tensor> source, List<MaybeTensor> planes, STEP_PARAMETERS) {
  const SceneTensors scene = scene_of(gaussians, camera, lens, options);
  const MaybeTensor grad_color = entry(planes, 0), grad_transmittance = entry(planes, 1);
  const MaybeTensor grad_inverse_depth = entry(planes, 2);
  const Step step{STEP_ARGUMENTS};
  step.check(scene);
  const Tensor pixels = packed(*radii), lengths = absolute_like(scene, absolute && step.observes());
  const GradientSource from(scene, SOURCE_ARGUMENTS, absolute, lengths.defined());
  with_scalar(scene.dtype(), [&](auto zero) {
    run(scene, from, lengths, step.of<decltype(zero)>(gaussians, pixels, scene.blocks()));
  });
  if (!now) advance(steps);
}

// Before a step of Adam, decides which blocks of Gaussians sleep through it, and lets the others take the steps that
// they have missed (math/sleep.h). sleep: awake, taken and terms of gs::SleepInput. rests: all wake, for no step yet.
// The other arguments are those of apply_gradients_; no counter advances. Returns on a GPU, unless all wake, the blocks
// that are awake (gs::Scene::blocks), with room for all of them, or for those that a host that runs ahead expects.
MaybeTensor wake_op(List<Tensor> gaussians, List<Tensor> camera, List<double> lens, Sizes options, List<Tensor> sleep,
                    bool rests, List<Tensor> averages, List<Tensor> steps, List<Tensor> guard, Sizes attributes,
                    List<double> rates, List<double> constants, Sizes columns, int64_t iteration,
                    const MaybeTensor& now) {
  const SceneTensors scene = scene_of(gaussians, camera, lens, options);
  const MaybeTensor none;
  const Step step{none,      averages, steps, {},        guard, attributes, rates,
                  constants, columns,  false, iteration, now,   false,      none};
  GS_CHECK_VALUE(scene.raw() && !scene.has(kCov3d) && !scene.has(kColors), "blocks of raw Gaussians sleep");
  GS_CHECK_VALUE(sleep.size() == 3, "give awake, taken and terms");
  step.check_adam(scene);
  const int64_t blocks = gs::sleep_blocks(scene.count());
  check_tensor(sleep[0], "awake", ScalarType::Byte, scene.device(), {blocks});
  check_tensor(sleep[1], "taken", ScalarType::Int, scene.device(), {blocks});
  check_tensor(sleep[2], "terms", scene.dtype(), scene.device(), {gs::kTerms, int64_t(gs::kTermColumns)});
  const bool all = rests || scene.rays() != gs::kNoRays;  // blocks are tested by EWA
  MaybeTensor listed;
  if (!all && scene.device().is_cuda())
    listed =
        empty<int32_t>({ahead() ? std::min(std::max<int64_t>(ahead()->room.blocks, 1), blocks) : blocks}, sleep[0]);
  with_scalar(scene.dtype(), [&](auto zero) {
    using T = decltype(zero);
    const gs::SleepInput<T> in{step.of<T>(gaussians, {}),
                               all,
                               rests,
                               write<uint8_t>(sleep[0]),
                               write<int32_t>(sleep[1]),
                               write<T>(sleep[2]),
                               listed ? write<int32_t>(*listed) : nullptr,
                               listed ? listed->size(0) : 0,
                               ahead()};
    GS_RUN(T, scene.means(), wake, scene.scene<T>(), in);
  });
  return listed;
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
  to->step = steps.size() ? int64_t(*read<float>(steps[0])) + 1 : 0;
  advance(steps);
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define(
      "apply_gradients_(Tensor(a!)[] gaussians, "
      "Tensor[] camera, " CAMERA_SCHEMA ", Tensor[] source, Tensor?[] planes, " STEP_SCHEMA ") -> ()",
      TORCH_BOX(&apply_gradients_op));
  m.define("wake_(Tensor(a!)[] gaussians, Tensor[] camera, " CAMERA_SCHEMA
           ", Tensor(b!)[] sleep, bool rests, Tensor(c!)[] averages, Tensor[] steps, Tensor[] guard, int[] attributes, "
           "float[] rates, float[] constants, int[] columns, int iteration=0, Tensor? now=None) -> Tensor?",
           TORCH_BOX(&wake_op));
  m.define(
      "step_now_(Tensor(a!) now, int[] attributes, Tensor(b!)[] steps, float[] rates, float beta1, float beta2, "
      "float eps, bool sparse, int iteration) -> ()",
      TORCH_BOX(&step_now_op));
}

}  // namespace gs::ops
