// Projection, Gaussian by Gaussian.
#include <cstring>

#include "../backend.h"
#include "../math/scene_row.h"
#include "list_tiles.h"

GS_ISA_BEGIN

namespace {

constexpr int64_t kGrain = 512;

// Most Gaussians of a trained scene lie outside of a view. This finds them without their shape.
template <class T>
bool surely_outside(const Scene<T>& s, const Camera<T>& camera, int64_t i) {
  if (!s.raw || s.cov3d) return false;
  return surely_outside(camera, load3(s.means + 3 * i), [&] {
    const Vec3<T> scales = load3(s.scales + 3 * i);
    return s.scale_modifier * std::exp(larger(larger(scales.x, scales.y), scales.z));
  });
}

template <class T>
void project_one(const Scene<T>& s, const Camera<T>& camera, int64_t i, const Projected<T>& out) {
  Splat<T> splat;
  int radius = 0;
  out.depths[i] = T(INFINITY);
  const bool visible = !surely_outside(s, camera, i) && project_shape(s, camera, i, splat, out.depths[i], radius);
  out.radii[i] = radius;
  out.tile_counts[i] = 0;
  if (out.records) out.records[i] = {};
  if (!visible) return;
  const TileRect rect = tile_rect(splat, s.image.width, s.image.height);
  uint64_t mask;
  const int32_t count = list_tiles(splat, rect, s.image, mask, nullptr);
  if (!count || !project_color(s, camera, i, s.sh_rest + s.rest_stride * i, splat)) return;
  out.tile_counts[i] = count;
  if (out.records)
    out.records[i] = {masked(rect) ? mask : uint64_t(count), uint16_t(rect.x0), uint16_t(rect.y0), uint16_t(rect.x1),
                      uint16_t(rect.y1)};
  if (out.rects) {
    int32_t* r = out.rects + 4 * i;
    r[0] = rect.x0, r[1] = rect.y0, r[2] = rect.x1, r[3] = rect.y1;
  }
  std::memcpy(out.splats + kSplatValues * i, &splat, sizeof splat);
}

}  // namespace

template <class T>
void project(const Executor& executor, const Scene<T>& s, const Projected<T>& out) {
  const Camera<T> camera = camera_of(s);
  for_dynamic(executor, s.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) project_one(s, camera, i, out);
  });
}

template <class T>
void mark_visible(const Executor& executor, int64_t count, const T* means, const T* view, bool* visible) {
  const Vec3<T> row_z = {view[2], view[6], view[10]};
  for_dynamic(executor, count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) visible[i] = in_front(dot(row_z, load3(means + 3 * i)) + view[14]);
  });
}

#define GS_INSTANTIATE(T)                                                          \
  template void project<T>(const Executor&, const Scene<T>&, const Projected<T>&); \
  template void mark_visible<T>(const Executor&, int64_t, const T*, const T*, bool*);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
