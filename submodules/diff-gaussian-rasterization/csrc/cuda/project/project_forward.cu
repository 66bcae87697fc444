// Projection, and the test of which means lie in front of the camera. A thread takes a Gaussian.
#include <cuda_runtime.h>

#include <type_traits>

#include "awake.cuh"
#include "backend.h"
#include "math/scene_row.h"
#include "sh_rows.cuh"
#include "splat_row.cuh"
#include "tile_record.cuh"
#include "tiles.cuh"

namespace gs {
namespace cuda {

namespace {

constexpr int kThreads = kSleepBlock;

// In front of the camera, and no farther off the image than a tenth of its size.
__device__ bool near_view(const Camera<float>& cam, Vec3<float> view) {
  const float x = cam.mean_focal_x * view.x + cam.axis_x * view.z, y = cam.mean_focal_y * view.y + cam.axis_y * view.z;
  const float spare_x = 0.1f * cam.width * view.z, spare_y = 0.1f * cam.height * view.z;
  return in_front(cam, view.z) && x > -spare_x && x < cam.width * view.z + spare_x && y > -spare_y &&
         y < cam.height * view.z + spare_y;
}

__device__ bool near_view(const LensCamera<float>&, Vec3<float>) { return true; }

// A Gaussian that sleeps, or none.
__device__ void leave_out(int64_t row, int64_t rows, const Projected<float>& out) {
  if (row >= rows) return;
  out.radii[row] = out.tile_counts[row] = 0;
  out.depths[row] = INFINITY;
  if (out.records) out.records[row] = TileRecord{};
}

template <class AnyCamera>
__global__ void __launch_bounds__(kThreads)
    project_kernel(const int32_t* halted, Scene<float> s, Projected<float> out) {
  if (!begin_work(halted)) return;
  const int64_t row = int64_t(blockIdx.x) * kThreads + threadIdx.x, block = awake_block(s, blockIdx.x);
  if (block < 0) return leave_out(row, s.rows(), out);
  __shared__ AnyCamera camera;
  __shared__ __align__(16) float rest[kThreads * kRest];
  const int64_t i = block * kThreads + threadIdx.x;
  // One thread makes the camera, in double, while the means arrive.
  const Vec3<float> mean = i < s.count ? load3(s.means + 3 * i) : Vec3<float>{};
  if (threadIdx.x == 0) set_camera(s, camera);
  __syncthreads();
  SplatOf<float, kOnRays<AnyCamera>> splat = {};
  float depth = INFINITY;
  int radius = 0;
  unsigned flowing = 0;
  const auto fetch = [&](bool wanted) {
    if (!s.colors)
      flowing = fetch_rows(s.sh_rest, i - (threadIdx.x & 31), s.count, s.rest_stride, 3 * (sh_count(s.sh_degree) - 1),
                           __ballot_sync(kWarp, wanted), flowing, rest + (threadIdx.x & ~31) * kRest);
  };
  // The coefficients of Gaussians that are likely seen arrive while the warp computes shapes.
  const bool likely = i < s.count && near_view(camera, to_view(camera, mean));
  fetch(likely);
  bool visible = i < s.count && project_shape(s, camera, SceneRow<float>{s, i}, splat, depth, radius);
  TileRect rect = {0, 0, 0, 0};
  if (visible) rect = rect_of(camera, splat, s.image);
  fetch(rect.x1 > rect.x0);
  uint64_t mask;
  int32_t count = warp_count_tiles<std::is_same_v<AnyCamera, LensCamera<float>>>(splat, rect, s.image, out.table, mask);
  wait_for_rows();
  if (count && !project_color(s, camera, SceneRow<float>{s, i}, rest + threadIdx.x * kRest, splat))
    count = 0, visible = false;
  if (row >= s.rows()) return;
  out.radii[row] = radius;
  out.tile_counts[row] = count;
  out.depths[row] = count ? depth : INFINITY;
  // A shape with tiles may still have a colour that is not finite: then `count` is 0.
  if (out.records) out.records[row] = tile_record(rect, count, mask);
  if (s.keeps_shapes && !visible) out.splats[splat_row(s.rays()) * row + kLog2Opacity] = -INFINITY;
  if (!count && !(s.keeps_shapes && visible)) return;
  if (out.rects && count) reinterpret_cast<int4*>(out.rects)[row] = make_int4(rect.x0, rect.y0, rect.x1, rect.y1);
  store_splat(out.splats, row, splat);
}

}  // namespace

template <>
void project<float>(const Queue& queue, const Scene<float>& s, const Projected<float>& out) {
  if (!s.rows()) return;
  const auto kernel = s.rays() == kLensRays             ? project_kernel<LensRayCamera<float>>
                      : s.rays()                        ? project_kernel<RayCamera<float>>
                      : s.lens.chart == Chart::kPinhole ? project_kernel<Camera<float>>
                                                        : project_kernel<LensCamera<float>>;
  launch(queue, "project", kernel, blocks_for(s.rows(), kThreads), kThreads, s, out);
}

}  // namespace cuda
}  // namespace gs
