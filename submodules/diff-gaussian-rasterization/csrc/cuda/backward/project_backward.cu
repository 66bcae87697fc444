// The backward of projection, and of the whole rasterizer. A thread takes a Gaussian.
#include <cuda_runtime.h>

#include <type_traits>

#include "backend.h"
#include "cuda/project/awake.cuh"
#include "cuda/project/sh_rows.cuh"
#include "cuda/step/gaussian_step.cuh"
#include "gradient_rows.cuh"
#include "math/scene_row.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = kSleepBlock;
constexpr int kBlocks = 5;  // that an SM is to hold at once: more registers do not pay

// A Gaussian's gradients, except those that go to memory or shared memory at once.
struct RowGradient {
  float means[3], means2d[3], opacity, scales[3], rotation[4], sh_dc[3];

  // As rows 0 of `out`; the gradients that are not held here go to row i. No pointer to a member depends on a
  // condition, or the members would lie in memory.
  __device__ SceneGradient<float> pointers(const SceneGradient<float>& out, int64_t i) {
    return {means,
            means2d,
            &opacity,
            scales,
            rotation,
            out.cov3d ? out.cov3d + 6 * i : nullptr,
            out.colors ? out.colors + 3 * i : nullptr,
            sh_dc,
            nullptr};
  }
};

__device__ void write_values(const float* values, int count, float* rows, int64_t i) {
  if (rows)
    for (int k = 0; k < count; ++k) rows[count * i + k] = values[k];
}

__device__ void write_gradient(const RowGradient& g, int64_t i, const SceneGradient<float>& out) {
  write_values(g.means, 3, out.means, i), write_values(g.means2d, 3, out.means2d, i);
  write_values(&g.opacity, 1, out.opacities, i), write_values(g.scales, 3, out.scales, i);
  write_values(g.rotation, 4, out.rotations, i), write_values(g.sh_dc, 3, out.sh_dc, i);
}

__device__ void write_gradient(const RowGradient& g, const WarpGradients& to) {
  const int lane = threadIdx.x & 31;
  write_values(g.means, 3, to.means(), lane), write_values(g.scales, 3, to.scales(), lane);
  write_values(g.sh_dc, 3, to.sh_dc(), lane), write_values(g.rotation, 4, to.rotations(), lane);
  to.opacities()[lane] = g.opacity;
}

// Computes gradients, and either writes them or takes the Gaussians' steps. It is one kernel for both, because a
// compiler may fuse other products in another, and both must go the same way to the last bit. Step: StepParameters or
// PenalisedStep, between which nothing differs but a call.
template <class AnyCamera, class Source, class Step>
__global__ void __launch_bounds__(kThreads, kOnRays<AnyCamera> == kLensRays ? kBlocks - 1 : kBlocks)
    project_vjp_kernel(const int32_t* halted, Scene<float> s, Source source, SceneGradient<float> out,
                       const __grid_constant__ Step step) {
  if (!begin_work(halted)) return;
  const int64_t block = awake_block(s, blockIdx.x);
  if (block < 0) return;
  constexpr int kRays = kOnRays<AnyCamera>;
  constexpr int kSums = SlotSums<kRays>::kStage,
                kStage = kSums > WarpGradients::kFloats ? kSums : WarpGradients::kFloats;
  __shared__ AnyCamera camera;
  __shared__ __align__(16) float rest[kThreads * kRest];
  __shared__ __align__(16) float stage[kThreads / 32 * kStage];
  const int64_t i = block * kThreads + threadIdx.x, first = i - (threadIdx.x & 31);
  const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x;  // in what the forward has made
  const bool seen = i < s.count && source.seen(at);
  float* row = rest + threadIdx.x * kRest;
  float* warp_rows = rest + (threadIdx.x & ~31) * kRest;
  float* warp_stage = stage + threadIdx.x / 32 * kStage;
  if (!s.colors)
    fetch_rows(s.sh_rest, first, s.count, s.rest_stride, 3 * (sh_count(s.sh_degree) - 1), __ballot_sync(kWarp, seen), 0,
               warp_rows);
  // One thread makes the camera, in double, while the block's memory arrives.
  if (threadIdx.x == 0) set_camera(s, camera);
  __syncwarp();
  float m[kGradientRow<kRays>];
  source.read(at, seen, m, warp_stage);
  wait_for_rows();
  __syncthreads();
  RowGradient g = {};
  const SceneGradient<float> mine = g.pointers(out, i);
  if (seen) {
    // Writes the row even if it is not wanted: a null pointer would be tested for every band.
    project_vjp_row(s, camera, SceneRow<float>{s, i}, m, row, row, mine, 0);
  } else if (i < s.count) {
    zero_row(mine.cov3d, 0, 6), zero_row(mine.colors, 0, 3);
    for (int k = 0; k < 3 * s.rest_bands; ++k) row[k] = 0;
  }
  if (first >= s.count) return;
  if (step.wanted) {
    if (step.observed.max_radii && i < s.count) observe_one(step.observed, i, at, g.means2d);
    const WarpGradients gradients{warp_stage};
    write_gradient(g, gradients);
    if (i < s.count) finish_one(step, i, gradients);
    step_gaussians<kRest>(step, first, s.count, gradients, warp_rows);
    return;
  }
  if (i < s.count) write_gradient(g, i, out);
  if (out.sh_rest)
    write_rows(warp_rows, first, int(s.count - first < 32 ? s.count - first : 32), 3 * s.rest_bands, out.sh_rest);
}

template <int kRays, class Source, class Step>
void launch_project_vjp(const Queue& queue, const Scene<float>& s, const Source& source,
                        const SceneGradient<float>& out, const Step& step) {
  const auto go = [&](auto kernel) {
    launch(queue, "project_vjp", kernel, blocks_for(s.rows(), kThreads), kThreads, s, source, out, step);
  };
  if constexpr (kRays == kLensRays)
    go(project_vjp_kernel<LensRayCamera<float>, Source, Step>);
  else if constexpr (kRays == kPinholeRays)
    go(project_vjp_kernel<RayCamera<float>, Source, Step>);
  else
    go(s.lens.chart == Chart::kPinhole ? project_vjp_kernel<Camera<float>, Source, Step>
                                       : project_vjp_kernel<LensCamera<float>, Source, Step>);
}

template <int kRays>
void launch_step(const Queue& queue, const Scene<float>& s, const SlotSums<kRays>& source,
                 const GaussianStep<float>& step) {
  if constexpr (kRays == kNoRays)
    if (step.camera) camera_vjp(queue, s, source, step.camera);
  const StepParameters parameters = step_parameters(step);
  if (step.penalty.any())
    launch_project_vjp<kRays>(queue, s, source, {}, PenalisedStep{parameters, step.penalty});
  else
    launch_project_vjp<kRays>(queue, s, source, {}, parameters);
}

// Without Gaussians, the gradients of the camera are 0.
void step_of_none(const Queue& queue, const Scene<float>& s, const GaussianStep<float>& step) {
  if (step.camera) camera_vjp(queue, s, SlotSums<false>{}, step.camera);
}

// Calls run(rays) with a constant, if there are Gaussians. There are no rows of those on the rays of a lens.
template <class Run>
void by_kind_of_rows(const Scene<float>& s, const Run& run) {
  if (!s.rows()) return;
  if (s.rays())
    run(std::integral_constant<int, kPinholeRays>());
  else
    run(std::integral_constant<int, kNoRays>());
}
// The same, also for rows of Gaussians on the rays of a lens.
template <class Run>
void by_kind(const Scene<float>& s, const Run& run) {
  if (s.rows()) by_rays(s.rays(), run);
}

}  // namespace

template <>
void project_vjp<float>(const Queue& queue, const Scene<float>& s, const int32_t* tile_counts, const float* moments,
                        const SceneGradient<float>& out) {
  by_kind(s, [&](auto rays) {
    launch_project_vjp<rays>(queue, s, StoredMoments<rays>{moments, tile_counts}, out, StepParameters{});
  });
}

void rasterize_vjp(const Queue& queue, const Scene<float>& s, const BlendInput<float>& in,
                   const BlendGradient<float>& g, const GradientMemory& memory) {
  by_kind(s, [&](auto rays) {
    const SlotSums<rays> source{fill_rows<rays>(queue, in, g), g.slots};
    launch_project_vjp<rays>(queue, s, source, memory.take(memory.context), StepParameters{});
  });
}

void rasterize_vjp_step(const Queue& queue, const Scene<float>& s, const BlendInput<float>& in,
                        const BlendGradient<float>& g, const GaussianStep<float>& step) {
  if (!s.rows()) return step_of_none(queue, s, step);
  by_kind(s, [&](auto rays) { launch_step<rays>(queue, s, {fill_rows<rays>(queue, in, g), g.slots}, step); });
}

void rows_vjp(const Queue& queue, const Scene<float>& s, const SplatRows<float>& in, const RowSums<float>& to,
              const GradientMemory& memory) {
  by_kind_of_rows(s, [&](auto rays) {
    const SlotSums<rays> source = sums_of<rays>(queue, in, to);
    launch_project_vjp<rays>(queue, s, source, memory.take(memory.context), StepParameters{});
  });
}

void rows_vjp_step(const Queue& queue, const Scene<float>& s, const SplatRows<float>& in, const RowSums<float>& to,
                   const GaussianStep<float>& step) {
  if (!s.rows()) return step_of_none(queue, s, step);
  by_kind_of_rows(s, [&](auto rays) { launch_step<rays>(queue, s, sums_of<rays>(queue, in, to), step); });
}

}  // namespace cuda
}  // namespace gs
