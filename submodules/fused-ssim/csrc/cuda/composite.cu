// Composites an image with alpha on a background. A thread takes a pixel.
#include <cuda_runtime.h>

#include "backend.h"
#include "gs/cuda_launch.h"
#include "math/composite.h"

namespace gs {
namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) composite_kernel(const int32_t* halted, Composite args) {
  if (!begin_work(halted)) return;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= args.pixels) return;
  const uint8_t alpha = args.picture[3 * args.pixels + i];
  for (int channel = 0; channel < 3; ++channel) {
    const int64_t at = channel * args.pixels + i;
    args.out[at] = composite(args.picture[at], alpha, args.background[channel]);
  }
}

}  // namespace

void composite(const Composite& args, const Queue& queue) {
  if (!args.pixels) return;
  const int64_t blocks = (args.pixels + kThreads - 1) / kThreads;
  launch(queue, "composite", composite_kernel, unsigned(blocks), kThreads, args);
}

}  // namespace gs
