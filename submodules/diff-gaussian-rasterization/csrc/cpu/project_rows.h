#pragma once
// Projection of a block of Gaussians, a vector of them at a time.
#include <algorithm>
#include <cstring>

#include "../backend.h"
#include "../math/lens_pixels.h"
#include "list_tiles.h"
#include "scene_lanes.h"

GS_ISA_BEGIN

namespace {

constexpr int64_t kProjectBlock = 512;

template <class T>
Projected<T> part_of(const Projected<T>& out, int64_t first) {
  const int row = splat_row(out.rays);
  return {from_row(out.splats, first, row),
          from_row(out.depths, first, 1),
          from_row(out.rects, first, 4),
          from_row(out.tile_counts, first, 1),
          from_row(out.radii, first, 1),
          from_row(out.records, first, 1),
          out.rays,
          out.table};
}

// Marks all Gaussians of a part as not shown.
template <class T>
void cull_all(int64_t count, const Projected<T>& out) {
  std::fill_n(out.depths, count, T(INFINITY));
  std::fill_n(out.tile_counts, count, 0), std::fill_n(out.radii, count, 0);
  if (out.records) std::fill_n(out.records, count, TileRecord{});
}

template <class T>
void cull_shapes(int64_t count, const Projected<T>& out) {
  for (int64_t i = 0; i < count; ++i) out.splats[splat_row(out.rays) * i + kLog2Opacity] = T(-INFINITY);
}

// Most Gaussians of a trained scene lie outside of a view. This finds them without their shape, and lists the others.
template <class T, class AnyCamera>
int64_t list_inside(const Scene<T>& s, const AnyCamera& camera, int32_t* inside) {
  for (int32_t i = 0; i < s.count; ++i) inside[i] = i;
  if (!s.raw || s.cov3d || s.lens.chart != Chart::kPinhole) return s.count;
  int64_t found = 0;
  for_packs<T>(inside, s.count, [&](const Pack<T>& pack) {
    using S = Simd<T>;
    const typename S::Mask outside = surely_outside(camera, read_means(s, pack), [&] {
      typename S::Vec scales[3];
      read_rows(s.scales, 3, s.count, 3, pack, scales);
      return s.scale_modifier * exponential(larger(larger(scales[0], scales[1]), scales[2]));
    });
    const uint32_t bits = S::bits(outside);
    for (int i = 0; i < pack.count; ++i) {
      inside[found] = pack.row[i];
      found += ~bits >> i & 1;
    }
  });
  return found;
}

template <class T, int kRays>
struct ProjectedPack {
  static constexpr int kRow = kSplatRow<kRays>;
  T splats[Simd<T>::kLanes * kRow], depths[Simd<T>::kLanes];
  typename IntOf<T>::type radii[Simd<T>::kLanes], rects[4][Simd<T>::kLanes];

  // Returns a bit for each Gaussian that is visible, unless it reaches no tile. shaped: also if it reaches none.
  template <class AnyCamera>
  uint32_t project(const Scene<T>& s, const AnyCamera& camera, const Pack<T>& pack, uint32_t& shaped) {
    using S = Simd<T>;
    using V = typename S::Vec;
    SceneLanes<T> row(s, pack);
    SplatOf<V, kRays> splat = {};
    V depth = {};
    typename S::Mask radius;
    typename S::Mask visible = project_shape(s, camera, row, splat, depth, radius);
    std::memcpy(radii, &radius, sizeof radii);
    if (!any(visible)) return 0;
    const Rect<typename S::Mask> rect = rect_of(camera, splat, s.image);
    if (s.keeps_shapes) shaped = S::bits(visible);
    visible &= rect.x1 > rect.x0;
    if (!any(visible) && !shaped) return 0;
    V rest[kMostRest];
    row.read_colors(s, pack, rest);
    const typename S::Mask colored = project_color(s, camera, row, rest, splat);
    visible &= colored;
    if (shaped) shaped &= S::bits(colored);
    std::memcpy(rects, &rect, sizeof rects), S::store(depths, depth);
    V values[kRow];
    std::memcpy(values, &splat, sizeof values);
    Pack<T> lanes = {{}, S::kLanes};
    for (int i = 0; i < S::kLanes; ++i) lanes.row[i] = i;
    write_rows(values, kRow, kRow, lanes, splats);
    return S::bits(visible);
  }
};

template <class T, int kRays>
bool write_splat(const ProjectedPack<T, kRays>& pack, int lane, Image image, int32_t i, const Projected<T>& out) {
  const auto& r = pack.rects;
  const TileRect rect = {int32_t(r[0][lane]), int32_t(r[1][lane]), int32_t(r[2][lane]), int32_t(r[3][lane])};
  SplatOf<T, kRays> splat;
  std::memcpy(&splat, pack.splats + pack.kRow * lane, sizeof splat);
  uint64_t mask;
  const int32_t count = list_tiles(splat, rect, image, out.table, mask, nullptr);
  if (!count) return false;
  out.tile_counts[i] = count, out.depths[i] = pack.depths[lane];
  if (out.records)
    out.records[i] = {masked(rect) ? mask : uint64_t(count), uint16_t(rect.x0), uint16_t(rect.y0), uint16_t(rect.x1),
                      uint16_t(rect.y1)};
  if (out.rects) {
    int32_t* to = out.rects + 4 * i;
    to[0] = rect.x0, to[1] = rect.y0, to[2] = rect.x1, to[3] = rect.y1;
  }
  std::memcpy(out.splats + pack.kRow * int64_t(i), &splat, sizeof splat);
  return true;
}

template <class T, class AnyCamera>
void project_block(const Scene<T>& s, const AnyCamera& camera, const Projected<T>& out) {
  int32_t inside[kProjectBlock];
  cull_all(s.count, out);
  if (s.keeps_shapes) cull_shapes(s.count, out);
  for_packs<T>(inside, list_inside(s, camera, inside), [&](const Pack<T>& pack) {
    ProjectedPack<T, kOnRays<AnyCamera>> projected;
    uint32_t shaped = 0;
    const uint32_t visible = projected.project(s, camera, pack, shaped);
    for (int lane = 0; lane < pack.count; ++lane) {
      const int32_t i = pack.row[lane];
      out.radii[i] = int32_t(projected.radii[lane]);
      const bool listed = visible >> lane & 1 && write_splat(projected, lane, s.image, i, out);
      if (!listed && shaped >> lane & 1)
        std::copy_n(projected.splats + projected.kRow * lane, projected.kRow, out.splats + projected.kRow * int64_t(i));
    }
  });
}

}  // namespace

// What a compiler puts into one function, and so fuses, depends on how many functions call it. So cameras of rays have
// a file of their own, and change no bit of the others.
template <class T>
void project_on_rays(const Scene<T>& s, const RayCamera<T>& camera, const Projected<T>& out);
template <class T>
void project_on_rays(const Scene<T>& s, const LensRayCamera<T>& camera, const Projected<T>& out);

GS_ISA_END
