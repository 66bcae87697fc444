#pragma once
// The step that Gaussians take inside the backward of projection, from gradients in shared memory. A warp steps the
// rows of its own 32 Gaussians, which lie side by side in every tensor, so that it reads and writes whole lines.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/queue/queue.cuh"
#include "guarded_adam.cuh"
#include "math/observe.h"
#include "math/step_now.h"
#include "penalty_row.cuh"

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
  bool whole;          // all rows but those of sh_rest are
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
  out.whole = true;
  for (int a = 0; a < kStepped; ++a) {
    const AdamInput<float>& from = in.attributes[a];
    bool whole = from.columns && from.columns == from.row;
    for (const float* p : {from.value, from.mean, from.square}) whole &= reinterpret_cast<uintptr_t>(p) % 16 == 0;
    out.rows[a] = {from.value, from.mean, from.square, int(from.row), int(from.columns), whole, {}};
    out.whole &= whole || a == kStepShRest;
    if (from.columns && !in.now)
      out.rows[a].constants = step_constants(in.sparse, from.lr, from.beta1, from.beta2, from.eps, from.step);
  }
  return out;
}

// 16 bytes of a tensor and of its averages.
struct Quad {
  float4 *value, *mean, *square;
};
__device__ inline Quad quad_at(const SteppedRows& rows, int64_t first, int k) {
  const int64_t at = first * rows.row / 4 + k;
  return {reinterpret_cast<float4*>(rows.value) + at, reinterpret_cast<float4*>(rows.mean) + at,
          reinterpret_cast<float4*>(rows.square) + at};
}

// Steps a warp's `count` quads, whose gradients lie side by side. quad(k) tells where the k-th is, constants(k) its
// tensor's. Returns whether the lane's values took their step. Several loads are under way before the first store,
// behind which a compiler moves none. No value is read again soon, so none should stay in the caches.
template <int kAhead, class At, class Constants>
__device__ __forceinline__ bool step_quads(int count, bool guarded, const float* gradient, const At& quad,
                                           const Constants& constants) {
  bool finite = true;
#pragma unroll 1
  for (int k = threadIdx.x & 31; k < count; k += 32 * kAhead) {
    float4 v[kAhead], m[kAhead], s[kAhead];
#pragma unroll
    for (int j = 0; j < kAhead; ++j) {
      if (k + 32 * j >= count) continue;
      const Quad from = quad(k + 32 * j);
      v[j] = __ldcs(from.value), m[j] = __ldcs(from.mean), s[j] = __ldcs(from.square);
    }
#pragma unroll
    for (int j = 0; j < kAhead; ++j) {
      const int at = k + 32 * j;
      if (at >= count) continue;
      const float4 g = reinterpret_cast<const float4*>(gradient)[at];
      const AdamConstants c = constants(at);
      finite &= step_value(guarded, c, g.x, v[j].x, m[j].x, s[j].x);
      finite &= step_value(guarded, c, g.y, v[j].y, m[j].y, s[j].y);
      finite &= step_value(guarded, c, g.z, v[j].z, m[j].z, s[j].z);
      finite &= step_value(guarded, c, g.w, v[j].w, m[j].w, s[j].w);
      const Quad to = quad(at);
      __stcs(to.value, v[j]), __stcs(to.mean, m[j]), __stcs(to.square, s[j]);
    }
  }
  return finite;
}

// Steps those of a warp's rows that have a bit in `stepping`. `gradient` has all 32 of them, `stride` floats apart; row
// `first` of the tensor is the first. Returns whether the lane's values took their step.
__device__ __noinline__ bool step_rows(const SteppedRows& to, const AdamConstants constants, bool guarded,
                                       unsigned stepping, int64_t first, const float* gradient, int stride) {
  bool finite = true;
  for (int k = threadIdx.x & 31; k < 32 * to.columns; k += 32) {
    const int row = k / to.columns, column = k - row * to.columns;
    if (!(stepping >> row & 1)) continue;
    const int64_t at = (first + row) * to.row + column;
    float value = to.value[at], mean = to.mean[at], square = to.square[at];
    finite &= step_value(guarded, constants, gradient[row * stride + column], value, mean, square);
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

  // Which tensor has the k-th 16 bytes, and which of its own they are.
  static constexpr int kQuads = kFloats / 4;
  struct Place {
    Stepped tensor;
    int k;
  };
  __device__ static Place place(int k) {
    return k < 24    ? Place{kStepMeans, k}
           : k < 48  ? Place{kStepScales, k - 24}
           : k < 72  ? Place{kStepShDc, k - 48}
           : k < 104 ? Place{kStepRotations, k - 72}
                     : Place{kStepOpacities, k - 104};
  }
};

// Adds the view to the statistics of Gaussian i, whose gradient on the screen this is. at: the row of its radius.
__device__ inline void observe_one(const ObserveInput& in, int64_t i, int64_t at, const float* gradient) {
  Observed o{in.max_radii[i], in.gradient_sums[i], in.views[i]};
  gs::observe(in.radii[at], gradient[0], gradient[1], o);
  in.max_radii[i] = o.max_radius, in.gradient_sums[i] = o.gradient_sum, in.views[i] = o.views;
}

// Adds the gradients of a penalty to those of the lane's Gaussian `i`.
__device__ __forceinline__ void finish_one(const StepParameters&, int64_t, const WarpGradients&) {}
__device__ inline void finish_one(const PenalisedStep& in, int64_t i, const WarpGradients& g) {
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
  const auto constants = [&](Stepped attribute) -> AdamConstants {
    if (!in.now) return in.rows[attribute].constants;
    const float* c = in.now->constants[attribute];
    return {c[0], c[1], c[2], c[3], c[4], c[5], c[6]};
  };
  const int64_t i = first + (threadIdx.x & 31);
  const unsigned stepping = __ballot_sync(kWarp, i < count && (!in.sparse || in.observed.radii[i] > 0));
  __syncwarp();  // all lanes have written their gradients
  const bool guarded = guard.stopped != nullptr;
  bool finite = true;
  const auto some = [&](Stepped attribute, const float* gradient, int stride) {
    if (in.rows[attribute].columns)
      finite &= step_rows(in.rows[attribute], constants(attribute), guarded, stepping, first, gradient, stride);
  };
  if (in.whole && stepping == kWarp) {
    const auto quad = [&](int k) {
      const WarpGradients::Place place = WarpGradients::place(k);
      return quad_at(in.rows[place.tensor], first, place.k);
    };
    finite &= step_quads<4>(WarpGradients::kQuads, guarded, g.memory, quad,
                            [&](int k) { return constants(WarpGradients::place(k).tensor); });
  } else {
    some(kStepMeans, g.means(), 3), some(kStepOpacities, g.opacities(), 1), some(kStepScales, g.scales(), 3);
    some(kStepRotations, g.rotations(), 4), some(kStepShDc, g.sh_dc(), 3);
  }
  const SteppedRows& of_rest = in.rows[kStepShRest];
  if (of_rest.whole && of_rest.row == kRest && stepping == kWarp) {
    const AdamConstants same = constants(kStepShRest);
    finite &= step_quads<3>(
        8 * kRest, guarded, rest, [&](int k) { return quad_at(of_rest, first, k); }, [&](int) { return same; });
  } else {
    some(kStepShRest, rest, kRest);
  }
  if (!finite) *guard.stopped = guard.iteration;  // every thread writes the same
}

}  // namespace cuda
}  // namespace gs
