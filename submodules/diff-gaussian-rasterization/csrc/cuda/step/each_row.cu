// Functions of every row by itself. A thread takes a row.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/project/awake.cuh"
#include "cuda/queue/queue.cuh"
#include "math/displace.h"
#include "math/elementary.h"
#include "math/observe.h"
#include "penalty_row.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__device__ int64_t row_of_thread() { return int64_t(blockIdx.x) * kThreads + threadIdx.x; }

__global__ void __launch_bounds__(kThreads) displace_kernel(const int32_t* halted, Displacement in) {
  if (!begin_work(halted) || (in.stopped && *in.stopped)) return;
  if (const int64_t i = row_of_thread(); i < in.count) gs::displace(in, i);
}

__global__ void __launch_bounds__(kThreads) elementary_kernel(const int32_t* halted, Elementary in) {
  if (!begin_work(halted)) return;
  if (const int64_t i = row_of_thread(); i < in.count) gs::elementary(in, i);
}

__global__ void __launch_bounds__(kThreads) random_words_kernel(const int32_t* halted, RandomInput in) {
  if (!begin_work(halted)) return;
  if (const int64_t i = row_of_thread(); i < in.count) gs::random_words(in, i);
}

__global__ void __launch_bounds__(kThreads) observe_kernel(const int32_t* halted, ObserveInput in) {
  if (!begin_work(halted)) return;
  const int64_t at = row_of_thread();
  if (at < in.count && (!in.blocks || in.radii[at])) gs::observe(in, gaussian_at(in.blocks, at), at);
}

__global__ void __launch_bounds__(kThreads) penalty_kernel(const int32_t* halted, PenaltyInput<float> in) {
  if (!begin_work(halted)) return;
  const int64_t i = row_of_thread();
  if (i >= in.count) return;
  penalise_opacity(in.penalty, in.logits + i, in.logit_gradients + i);
  penalise_scales(in.penalty, in.log_scales + 3 * i, in.log_scale_gradients + 3 * i);
}

template <class Input>
void launch_rows(const Queue& queue, const char* name, void (*kernel)(const int32_t*, Input), const Input& in) {
  if (in.count) launch(queue, name, kernel, blocks_for(in.count, kThreads), kThreads, in);
}

}  // namespace

void displace(const Queue& queue, const Displacement& in) { launch_rows(queue, "displace", displace_kernel, in); }

void elementary(const Queue& queue, const Elementary& in) { launch_rows(queue, "elementary", elementary_kernel, in); }

void random_words(const Queue& queue, const RandomInput& in) {
  launch_rows(queue, "random_words", random_words_kernel, in);
}

void observe(const Queue& queue, const ObserveInput& in) { launch_rows(queue, "observe", observe_kernel, in); }

template <>
void penalise<float>(const Queue& queue, const PenaltyInput<float>& in) {
  launch_rows(queue, "penalise", penalty_kernel, in);
}

}  // namespace cuda
}  // namespace gs
