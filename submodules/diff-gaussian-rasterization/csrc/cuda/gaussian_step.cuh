#pragma once
// The step that Gaussians take inside the backward of projection, from gradients in shared memory. A warp steps the
// rows of its own 32 Gaussians, which lie side by side in every tensor, so that it reads and writes whole lines.
#include <cuda_runtime.h>

#include "../backend.h"
#include "../math/observe.h"
#include "../math/step_now.h"
#include "guarded_adam.cuh"
#include "penalty_row.cuh"
#include "queue.cuh"

namespace gs {
namespace cuda {

// A tensor's rows. whole: all columns step, and 32 rows begin at a multiple of 16 bytes.
struct SteppedRows {
  float *value, *mean, *square;
  int row, columns;
  bool whole;
  AdamConstants constants;
};

struct StepParameters {
  bool wanted;
  const StepNow* now;  // what stands in for the rows' constants and the guard's iteration, or null
  bool sparse;
  SteppedRows rows[kStepped];
  StepGuard<float> guard;
  ObserveInput observed;
};

// Of a step with a penalty. It is a type of its own, so that other steps have no code for it.
struct PenalisedStep : StepParameters {
  Penalty<float> penalty;
};

inline StepParameters step_parameters(const GaussianStep<float>& in) {
  StepParameters out{};
  out.wanted = true, out.now = in.now, out.sparse = in.sparse, out.guard = in.guard, out.observed = in.observed;
  for (int a = 0; a < kStepped; ++a) {
    const AdamInput<float>& from = in.attributes[a];
    bool whole = from.columns == from.row;
    for (const float* p : {from.value, from.mean, from.square}) whole &= reinterpret_cast<uintptr_t>(p) % 16 == 0;
    out.rows[a] = {from.value, from.mean, from.square, int(from.row), int(from.columns), whole, {}};
    if (from.columns && !in.now)
      out.rows[a].constants = step_constants(in.sparse, from.lr, from.beta1, from.beta2, from.eps, from.step);
  }
  return out;
}

// Steps all 32 rows of a warp, 16 bytes a lane at a time; their gradients lie side by side. Returns whether the lane's
// values took their step. Several loads are under way before the first store, behind which a compiler moves none. No
// value is read again soon, so none should stay in the caches.
template <int kRow>
__device__ inline bool step_whole_rows(SteppedRows to, bool guarded, int64_t first, const float* gradient) {
  constexpr int kCount = 8 * kRow, kAhead = kCount > 64 ? 3 : 1;
  bool finite = true;
  float4 *value = reinterpret_cast<float4*>(to.value + first * kRow),
         *mean = reinterpret_cast<float4*>(to.mean + first * kRow),
         *square = reinterpret_cast<float4*>(to.square + first * kRow);
#pragma unroll 1
  for (int k = threadIdx.x & 31; k < kCount; k += 32 * kAhead) {
    float4 v[kAhead], m[kAhead], s[kAhead];
#pragma unroll
    for (int j = 0; j < kAhead; ++j)
      if (k + 32 * j < kCount)
        v[j] = __ldcs(value + k + 32 * j), m[j] = __ldcs(mean + k + 32 * j), s[j] = __ldcs(square + k + 32 * j);
#pragma unroll
    for (int j = 0; j < kAhead; ++j) {
      const int at = k + 32 * j;
      if (at >= kCount) continue;
      const float4 g = reinterpret_cast<const float4*>(gradient)[at];
      finite &= step_value(guarded, to.constants, g.x, v[j].x, m[j].x, s[j].x);
      finite &= step_value(guarded, to.constants, g.y, v[j].y, m[j].y, s[j].y);
      finite &= step_value(guarded, to.constants, g.z, v[j].z, m[j].z, s[j].z);
      finite &= step_value(guarded, to.constants, g.w, v[j].w, m[j].w, s[j].w);
      __stcs(value + at, v[j]), __stcs(mean + at, m[j]), __stcs(square + at, s[j]);
    }
  }
  return finite;
}

// Steps those of a warp's rows that have a bit in `stepping`. `gradient` has all 32 of them, `stride` floats apart; row
// `first` of the tensor is the first. kRow: the values of a row, as is usual. Returns whether the lane's values took
// their step.
template <int kRow>
__device__ inline bool step_rows(SteppedRows to, bool guarded, unsigned stepping, int64_t first, const float* gradient,
                                 int stride) {
  if (!to.columns) return true;
  if (to.whole && to.row == kRow && stride == kRow && stepping == kWarp)
    return step_whole_rows<kRow>(to, guarded, first, gradient);
  bool finite = true;
  for (int k = threadIdx.x & 31; k < 32 * to.columns; k += 32) {
    const int row = k / to.columns, column = k - row * to.columns;
    if (!(stepping >> row & 1)) continue;
    const int64_t at = (first + row) * to.row + column;
    float value = to.value[at], mean = to.mean[at], square = to.square[at];
    finite &= step_value(guarded, to.constants, gradient[row * stride + column], value, mean, square);
    to.value[at] = value, to.mean[at] = mean, to.square[at] = square;
  }
  return finite;
}

// The gradients of a warp's Gaussians in shared memory, except those of sh_rest.
struct WarpGradients {
  static constexpr int kFloats = 32 * (3 + 1 + 3 + 4 + 3);
  float* memory;  // kFloats
  __device__ float* means() const { return memory; }
  __device__ float* scales() const { return memory + 32 * 3; }
  __device__ float* sh_dc() const { return memory + 32 * 6; }
  __device__ float* rotations() const { return memory + 32 * 9; }
  __device__ float* opacities() const { return memory + 32 * 13; }
};

// Adds the view to the statistics of Gaussian i, whose gradient on the screen this is. at: the row of its radius.
__device__ inline void observe_one(const ObserveInput& in, int64_t i, int64_t at, const float* gradient) {
  Observed o{in.max_radii[i], in.gradient_sums[i], in.views[i]};
  gs::observe(in.radii[at], gradient[0], gradient[1], o);
  in.max_radii[i] = o.max_radius, in.gradient_sums[i] = o.gradient_sum, in.views[i] = o.views;
}

// Adds the gradients of a penalty to those of the lane's Gaussian `i`.
__device__ __forceinline__ void penalise_one(const StepParameters&, int64_t, const WarpGradients&) {}
__device__ inline void penalise_one(const PenalisedStep& in, int64_t i, const WarpGradients& g) {
  const int lane = threadIdx.x & 31;
  const SteppedRows &logits = in.rows[kStepOpacities], &log_scales = in.rows[kStepScales];
  if (logits.columns) penalise_opacity(in.penalty, logits.value + i, g.opacities() + lane);
  if (log_scales.columns) penalise_scales(in.penalty, log_scales.value + 3 * i, g.scales() + 3 * lane);
}

// Takes the step of a warp's Gaussians; all of its lanes call it. `first` is the warp's first Gaussian, `rest` has
// their gradients of sh_rest, kRest floats apart. Inlined, it would take the whole kernel from 96 to 104 registers,
// with which one block in five would no longer fit.
template <int kRest>
__device__ __noinline__ void step_gaussians(const StepParameters& in, int64_t first, int64_t count,
                                            const WarpGradients& g, const float* rest) {
  StepGuard<float> guard = in.guard;
  if (in.now) guard.iteration = in.now->iteration;
  if (!begin_step(guard)) return;
  const auto rows = [&](Stepped attribute) {
    SteppedRows to = in.rows[attribute];
    if (in.now) {
      const float* c = in.now->constants[attribute];
      to.constants = {c[0], c[1], c[2], c[3], c[4], c[5], c[6]};
    }
    return to;
  };
  const int64_t i = first + (threadIdx.x & 31);
  const unsigned stepping = __ballot_sync(kWarp, i < count && (!in.sparse || in.observed.radii[i] > 0));
  __syncwarp();  // all lanes have written their gradients
  const bool guarded = guard.stopped != nullptr;
  bool finite = step_rows<3>(rows(kStepMeans), guarded, stepping, first, g.means(), 3);
  finite &= step_rows<1>(rows(kStepOpacities), guarded, stepping, first, g.opacities(), 1);
  finite &= step_rows<3>(rows(kStepScales), guarded, stepping, first, g.scales(), 3);
  finite &= step_rows<4>(rows(kStepRotations), guarded, stepping, first, g.rotations(), 4);
  finite &= step_rows<3>(rows(kStepShDc), guarded, stepping, first, g.sh_dc(), 3);
  finite &= step_rows<kRest>(rows(kStepShRest), guarded, stepping, first, rest, kRest);
  if (!finite) *guard.stopped = guard.iteration;  // every thread writes the same
}

}  // namespace cuda
}  // namespace gs
