// Adam's step without a gradient, of the rows of Gaussians that the view does not see. It runs beside the exchange
// of several GPUs, in which a GPU's memory is mostly idle.
#include <cuda_runtime.h>

#include <algorithm>

#include "../backend.h"
#include "../math/step_now.h"
#include "gaussian_step.cuh"
#include "sh_rows.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;
constexpr unsigned kBlocks = 132;  // at most: one for each multiprocessor of an H200, so that others find room

__global__ void __launch_bounds__(kThreads) step_unseen_kernel(const int32_t* halted, SteppedRows to, int64_t count,
                                                               const int32_t* counts, StepGuard<float> guard) {
  if (is_halted(halted) || !begin_step(guard)) return;
  __shared__ __align__(16) float zero[32 * kRest];
  for (int k = threadIdx.x; k < 32 * kRest; k += kThreads) zero[k] = 0;
  __syncthreads();
  const bool guarded = guard.stopped != nullptr, whole = to.whole;
  const int64_t stride = int64_t(gridDim.x) * kThreads;
  bool finite = true;
  for (int64_t first = int64_t(blockIdx.x) * kThreads + (threadIdx.x & ~31); first < count; first += stride) {
    const int64_t i = first + (threadIdx.x & 31);
    const unsigned unseen = __ballot_sync(kWarp, i < count && counts[i] == 0);
    if (!unseen) continue;
    to.whole = whole && first + 32 <= count;
    finite &= step_rows<kRest>(to, guarded, unseen, first, zero, kRest);
  }
  if (!finite) *guard.stopped = guard.iteration;  // every thread writes the same
}

}  // namespace

template <>
void step_unseen<float>(const Queue& queue, const AdamInput<float>& in, const int32_t* counts,
                        const StepGuard<float>& guard) {
  if (!in.rows || !in.columns) return;
  SteppedRows to = stepped_rows(in);
  to.constants = step_constants(false, in.lr, in.beta1, in.beta2, in.eps, in.step);
  const unsigned blocks = std::min(blocks_for(in.rows, kThreads), kBlocks);
  step_unseen_kernel<<<blocks, kThreads, 0, stream_of(queue)>>>(queue.halted, to, in.rows, counts, guard);
  check_launch("step_unseen");
}

}  // namespace cuda
}  // namespace gs
