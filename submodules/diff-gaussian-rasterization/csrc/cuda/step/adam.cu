// Adam's step of many tensors, in one launch.
#include <cuda_runtime.h>

#include "backend.h"
#include "cuda/queue/queue.cuh"
#include "guarded_adam.cuh"
#include "math/adam.h"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kTensors = 16;  // of one launch; each takes 130 bytes of the 4 KiB that a kernel's parameters may have

struct Tensors {
  AdamInput<float> in[kTensors];
  AdamConstants step[kTensors];
  int64_t end[kTensors];  // the first block behind this tensor's
  StepGuard<float> guard;
};

__global__ void __launch_bounds__(kThreads)
    adam_kernel(const int32_t* halted, const __grid_constant__ Tensors tensors) {
  if (!begin_work(halted) || !begin_step(tensors.guard)) return;
  int which = 0;
  while (int64_t(blockIdx.x) >= tensors.end[which]) ++which;
  const AdamInput<float>& in = tensors.in[which];
  const int64_t block = int64_t(blockIdx.x) - (which ? tensors.end[which - 1] : 0);
  const int64_t k = block * kThreads + threadIdx.x;
  if (k >= in.rows * in.columns) return;
  const int64_t i = in.columns == in.row ? k : k / in.columns * in.row + k % in.columns;
  step_value(tensors.guard, tensors.step[which], in, i);
}

}  // namespace

template <>
void adam<float>(const Queue& queue, const AdamInput<float>* tensors, int64_t count, const StepGuard<float>& guard) {
  for (int64_t first = 0; first < count; first += kTensors) {
    const int n = int(count - first < kTensors ? count - first : kTensors);
    Tensors some = {};
    some.guard = guard;
    int64_t blocks = 0;
    for (int i = 0; i < n; ++i) {
      const AdamInput<float>& in = tensors[first + i];
      some.in[i] = in;
      some.step[i] = baseline::make_adam_step<float>(in.lr, in.beta1, in.beta2, in.eps, in.step);
      blocks += blocks_for(in.rows * in.columns, kThreads);
      some.end[i] = blocks;
    }
    if (!blocks) continue;
    launch(queue, "adam", adam_kernel, unsigned(blocks), kThreads, some);
  }
}

}  // namespace cuda
}  // namespace gs
