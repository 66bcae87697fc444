// A thread per Gaussian; rows of sh_rest pass through shared memory, since a thread's own 180 bytes are not coalesced.
#include <cuda_pipeline.h>
#include <cuda_runtime.h>

#include "../math/scene_row.h"
#include "backward.cuh"
#include "tiles.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = 128;
constexpr int kRest = 3 * (sh_count(kMaxShDegree) - 1);  // 45 values: odd, so rows lie in different banks

dim3 blocks_for(int64_t n) { return dim3(unsigned((n + kThreads - 1) / kThreads)); }

// Copying all 32 rows costs 12 copies a lane, one row 2: with this many wanted, reading the others too is cheaper.
constexpr int kManyRows = 20;

// The warp's rows of sh_rest, of `count` in all: those `wanted` (a bit per lane), `values` of each, start to flow into
// shared memory, but for those that do already. Nobody waits for one row before asking for the next. Returns which rows
// flow then, maybe more than wanted.
__device__ unsigned fetch_rows(const float* global, int64_t first, int64_t count, int64_t stride, int values,
                               unsigned wanted, unsigned flowing, float* rows) {
  wanted &= ~flowing;
  if (!wanted) return flowing;
  const int lane = threadIdx.x & 31;
  const float* from = global + first * stride;
  if (!flowing && __popc(wanted) >= kManyRows && first + 32 <= count && stride == kRest && values == kRest &&
      reinterpret_cast<uintptr_t>(from) % 16 == 0) {
#pragma unroll
    for (int k = 0; k < (kRest * 32 + 127) / 128; ++k) {
      const int at = 4 * (32 * k + lane);
      if (at < kRest * 32) __pipeline_memcpy_async(rows + at, from + at, 16);
    }
    wanted = kWarp;
  } else {
    for (unsigned left = wanted; left; left &= left - 1) {
      const int row = __ffs(left) - 1;
      for (int v = lane; v < values; v += 32)
        __pipeline_memcpy_async(rows + row * kRest + v, from + row * stride + v, sizeof(float));
    }
  }
  __pipeline_commit();
  return flowing | wanted;
}
__device__ void wait_for_rows() {
  __pipeline_wait_prior(0);
  __syncwarp();
}

// The warp's first `count` rows, `values` of each, to where rows of that many values lie side by side.
__device__ void write_rows(const float* rows, int64_t first, int count, int values, float* global) {
  __syncwarp();
  const int lane = threadIdx.x & 31;
  float* to = global + first * values;
  if (values == kRest && count == 32 && reinterpret_cast<uintptr_t>(to) % 16 == 0) {
#pragma unroll
    for (int k = 0; k < (kRest * 32 + 127) / 128; ++k) {
      const int at = 32 * k + lane;
      if (4 * at < kRest * 32) reinterpret_cast<float4*>(to)[at] = reinterpret_cast<const float4*>(rows)[at];
    }
  } else {
    for (int row = 0; row < count; ++row)
      for (int v = lane; v < values; v += 32) to[row * values + v] = rows[row * kRest + v];
  }
}

// In front, and no further off the image than a tenth of its size.
__device__ bool near_view(const Camera<float>& cam, Vec3<float> view) {
  const float x = cam.mean_focal_x * view.x + cam.axis_x * view.z, y = cam.mean_focal_y * view.y + cam.axis_y * view.z;
  const float spare_x = 0.1f * cam.width * view.z, spare_y = 0.1f * cam.height * view.z;
  return in_front(view.z) && x > -spare_x && x < cam.width * view.z + spare_x && y > -spare_y &&
         y < cam.height * view.z + spare_y;
}

__global__ void __launch_bounds__(kThreads) project_kernel(Scene<float> s, Projected<float> out) {
  __shared__ Camera<float> camera;
  __shared__ __align__(16) float rest[kThreads * kRest];
  if (threadIdx.x == 0) camera = camera_of(s);
  __syncthreads();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  Splat<float> splat = {};
  float depth = INFINITY;
  int radius = 0;
  unsigned flowing = 0;
  const auto fetch = [&](bool wanted) {
    if (!s.colors)
      flowing = fetch_rows(s.sh_rest, i - (threadIdx.x & 31), s.count, s.rest_stride, 3 * (sh_count(s.sh_degree) - 1),
                           __ballot_sync(kWarp, wanted), flowing, rest + (threadIdx.x & ~31) * kRest);
  };
  // Coefficients of what is likely seen are on their way while the shape is worked out.
  const bool likely = i < s.count && near_view(camera, to_view(camera, load3(s.means + 3 * i)));
  fetch(likely);
  const bool visible = i < s.count && project_shape(s, camera, i, splat, depth, radius);
  TileRect rect = {0, 0, 0, 0};
  if (visible) rect = tile_rect(splat, s.image.width, s.image.height);
  fetch(rect.x1 > rect.x0);
  uint64_t mask;
  int32_t count = warp_count_tiles(splat, rect, s.image, mask);
  wait_for_rows();
  if (count && !project_color(s, camera, i, rest + threadIdx.x * kRest, splat)) count = 0;
  if (i >= s.count) return;
  out.radii[i] = radius;
  out.tile_counts[i] = count;
  out.depths[i] = count ? depth : INFINITY;
  if (out.records) {
    if (!count) rect = {0, 0, 0, 0}, mask = 0;  // also where the shape has tiles and the colour is not finite
    const uint64_t reached = (rect.x1 - rect.x0) * (rect.y1 - rect.y0) <= 64 ? mask : uint64_t(count);
    out.records[i] = {reached, uint16_t(rect.x0), uint16_t(rect.y0), uint16_t(rect.x1), uint16_t(rect.y1)};
  }
  if (!count) return;
  if (out.rects) reinterpret_cast<int4*>(out.rects)[i] = make_int4(rect.x0, rect.y0, rect.x1, rect.y1);
  float2* to = reinterpret_cast<float2*>(out.splats + kSplatValues * i);
  to[0] = make_float2(splat.x, splat.y);
  to[1] = make_float2(splat.l11, splat.l12);
  to[2] = make_float2(splat.l22, splat.log2_opacity);
  to[3] = make_float2(splat.r, splat.g);
  to[4] = make_float2(splat.b, splat.inverse_depth);
}

// Where a splat's moments come from when they were summed up before.
struct StoredMoments {
  const float* moments;
  const int32_t* tile_counts;
  __device__ bool seen(int64_t i) const { return tile_counts[i] != 0; }
  __device__ void read(int64_t i, bool wanted, float* m, float* /*stage*/) const {
    for (int v = 0; wanted && v < kGradientValues; ++v) m[v] = moments[kGradientValues * i + v];
  }
};

template <class Source>
__global__ void __launch_bounds__(kThreads)
    project_vjp_kernel(Scene<float> s, Source source, SceneGradient<float> out) {
  __shared__ Camera<float> camera;
  __shared__ __align__(16) float rest[kThreads * kRest];
  __shared__ __align__(8) float stage[kThreads / 32 * SlotSums::kStage];
  if (threadIdx.x == 0) camera = camera_of(s);
  __syncthreads();
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, first = i - (threadIdx.x & 31);
  const bool seen = i < s.count && source.seen(i);
  float* row = rest + threadIdx.x * kRest;
  float* warp_rows = rest + (threadIdx.x & ~31) * kRest;
  if (!s.colors)
    fetch_rows(s.sh_rest, first, s.count, s.rest_stride, 3 * (sh_count(s.sh_degree) - 1), __ballot_sync(kWarp, seen), 0,
               warp_rows);
  float m[kGradientValues];
  source.read(i, seen, m, stage + threadIdx.x / 32 * SlotSums::kStage);
  wait_for_rows();
  if (seen) {
    project_vjp_row(s, camera, i, m, row, row, out);  // writes the row unasked: a null would be tested for every band
  } else if (i < s.count) {
    zero_gradient(i, out);
    for (int k = 0; k < 3 * s.rest_bands; ++k) row[k] = 0;
  }
  if (out.sh_rest && first < s.count)
    write_rows(warp_rows, first, int(s.count - first < 32 ? s.count - first : 32), 3 * s.rest_bands, out.sh_rest);
}

__global__ void mark_visible_kernel(int64_t count, const float* means, const float* view, bool* visible) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < count) visible[i] = in_front(dot(Vec3<float>{view[2], view[6], view[10]}, load3(means + 3 * i)) + view[14]);
}

}  // namespace

template <>
void project<float>(const Queue& queue, const Scene<float>& s, const Projected<float>& out) {
  if (!s.count) return;
  project_kernel<<<blocks_for(s.count), kThreads, 0, stream_of(queue)>>>(s, out);
  check_launch("project");
}

template <>
void project_vjp<float>(const Queue& queue, const Scene<float>& s, const int32_t* tile_counts, const float* moments,
                        const SceneGradient<float>& out) {
  if (!s.count) return;
  const StoredMoments source{moments, tile_counts};
  project_vjp_kernel<<<blocks_for(s.count), kThreads, 0, stream_of(queue)>>>(s, source, out);
  check_launch("project_vjp");
}

void rasterize_vjp(const Queue& queue, const Scene<float>& s, const BlendInput<float>& in,
                   const BlendGradient<float>& g, const GradientMemory& memory) {
  if (!s.count) return;
  const SlotSums source{blend_rows(queue, in, g), g.slots};
  const SceneGradient<float> out = memory.take(memory.context);
  project_vjp_kernel<<<blocks_for(s.count), kThreads, 0, stream_of(queue)>>>(s, source, out);
  check_launch("project_vjp");
}

template <>
void mark_visible<float>(const Queue& queue, int64_t count, const float* means, const float* view, bool* visible) {
  if (!count) return;
  mark_visible_kernel<<<blocks_for(count), kThreads, 0, stream_of(queue)>>>(count, means, view, visible);
  check_launch("mark_visible");
}

}  // namespace cuda
}  // namespace gs
