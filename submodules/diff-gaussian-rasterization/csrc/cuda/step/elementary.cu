// Functions of every row by itself. A thread takes a row.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/queue/queue.cuh"
#include "math/elementary.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) elementary_kernel(const int32_t* halted, Elementary in) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.count) gs::elementary(in, i);
}

__global__ void __launch_bounds__(kThreads) random_words_kernel(const int32_t* halted, RandomInput in) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.count) gs::random_words(in, i);
}

}  // namespace

void elementary(const Queue& queue, const Elementary& in) {
  if (in.count) launch(queue, "elementary", elementary_kernel, blocks_for(in.count, kThreads), kThreads, in);
}

void random_words(const Queue& queue, const RandomInput& in) {
  if (in.count) launch(queue, "random_words", random_words_kernel, blocks_for(in.count, kThreads), kThreads, in);
}

}  // namespace cuda
}  // namespace gs
