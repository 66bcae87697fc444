// The steps that lazy rows lack. A warp takes the rows of 32 Gaussians: first each lane looks at its own, then all of
// them share out the values.
#include <cuda_runtime.h>

#include "../backend.h"
#include "../math/scene_row.h"
#include "lazy_rows.cuh"

namespace gs {
namespace cuda {

using namespace baseline;

namespace {

constexpr int kThreads = 128;

// Takes the late steps of one value. Returns whether it may wait again.
__device__ bool catch_up_value(const AdamInput<float>& in, const float* ring, int attribute, int64_t at, int32_t last,
                               int32_t taken) {
  float value = in.value[at], mean = in.mean[at], square = in.square[at];
  if (__float_as_uint(mean) | __float_as_uint(square)) {
    take_late_steps<OneLane<float>>(ring, attribute, last, taken, value, mean, square);
    in.value[at] = value, in.mean[at] = mean, in.square[at] = square;
  }
  return may_wait(value, mean, square);
}

__global__ void __launch_bounds__(kThreads)
    catch_up_kernel(const int32_t* halted, Scene<float> s, const __grid_constant__ CatchUp<float> in) {
  if (is_halted(halted)) return;
  __shared__ Camera<float> camera;
  if (!in.all) {
    if (threadIdx.x == 0) camera = camera_of(s);
    __syncthreads();
  }
  const int lane = threadIdx.x & 31;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, first = i - lane;
  const int32_t taken = *in.rows.taken, last = i < s.count ? in.rows.last[i] : kEveryStep;
  const bool lacks = last >= 0 && last < taken && (in.all || may_be_seen(s, camera, i));
  const unsigned lacking = __ballot_sync(kWarp, lacks);
  if (!lacking) return;
  const int mine = nth_bit(lacking, lane), dc = int(in.attributes[0].columns);
  const int values = dc + int(in.attributes[1].columns), count = __popc(lacking) * values;
  bool waiting = true;
  for (int begin = 0; begin < count; begin += 32) {
    const int k = begin + lane, nth = k / values, column = k - nth * values;
    const int row = __shfl_sync(kWarp, mine, nth & 31);
    const int32_t since = __shfl_sync(kWarp, last, row);
    if (k >= count) continue;
    const int attribute = column < dc ? 0 : 1;
    const AdamInput<float>& to = in.attributes[attribute];
    const int64_t at = (first + row) * to.row + column - attribute * dc;
    waiting &= catch_up_value(to, in.rows.ring, attribute, at, since, taken);
  }
  note_rows(in.rows, taken, first, lacking, waiting);
}

}  // namespace

template <>
void catch_up<float>(const Queue& queue, const Scene<float>& s, const CatchUp<float>& in) {
  if (!s.count) return;
  catch_up_kernel<<<blocks_for(s.count, kThreads), kThreads, 0, stream_of(queue)>>>(queue.halted, s, in);
  check_launch("catch_up");
}

}  // namespace cuda
}  // namespace gs
