// Adds a view to the statistics of density control. A thread takes a Gaussian.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/project/awake.cuh"
#include "cuda/queue/queue.cuh"
#include "math/observe.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) observe_kernel(const int32_t* halted, ObserveInput in) {
  if (!begin_work(halted)) return;
  const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (at >= in.count || (in.blocks && !in.radii[at])) return;
  const int64_t i = gaussian_at(in.blocks, at);
  Observed o{in.max_radii[i], in.gradient_sums[i], in.views[i]};
  if (in.lengths)
    gs::observe(in.radii[at], in.lengths[at], o);
  else
    gs::observe(in.radii[at], in.gradients[3 * at], in.gradients[3 * at + 1], o);
  in.max_radii[i] = o.max_radius, in.gradient_sums[i] = o.gradient_sum, in.views[i] = o.views;
}

}  // namespace

void observe(const Queue& queue, const ObserveInput& in) {
  if (!in.count) return;
  launch(queue, "observe", observe_kernel, blocks_for(in.count, kThreads), kThreads, in);
}

}  // namespace cuda
}  // namespace gs
