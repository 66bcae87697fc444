#pragma once
// The gradients of a block of Gaussians, a vector of them at a time.
#include <cstring>

#include "../backend.h"
#include "scene_lanes.h"

GS_ISA_BEGIN

namespace {

constexpr int64_t kVjpBlock = kSleepBlock;  // Gaussians whose gradients, some 30 KB of floats, stay in a core's cache

template <class T>
SceneGradient<T> part_of(const SceneGradient<T>& g, int64_t first, int rest_bands) {
  return {from_row(g.means, first, 3),  from_row(g.means2d, first, 3),   from_row(g.opacities, first, 1),
          from_row(g.scales, first, 3), from_row(g.rotations, first, 4), from_row(g.cov3d, first, 6),
          from_row(g.colors, first, 3), from_row(g.sh_dc, first, 3),     from_row(g.sh_rest, first, 3 * rest_bands)};
}

// Lists the Gaussians that were seen. Zeroes the gradients of the others.
template <class T>
int64_t list_seen(const Scene<T>& s, const int32_t* tile_counts, const SceneGradient<T>& out, int32_t* seen) {
  int64_t found = 0;
  for (int64_t i = 0; i < s.count; ++i) {
    if (tile_counts[i]) {
      seen[found++] = int32_t(i);
    } else {
      zero_gradient(i, out);
      if (out.sh_rest) std::memset(out.sh_rest + 3 * s.rest_bands * i, 0, 3 * s.rest_bands * sizeof(T));
    }
  }
  return found;
}

template <class T>
const T* from_moments(const Scene<T>& s, const T* moments, int64_t first) {
  return moments + gradient_row(s.rays()) * first;
}

// The gradients of a vector of Gaussians.
template <class T>
struct PackGradient {
  using V = typename Simd<T>::Vec;
  V means[3], means2d[3], opacities[1], scales[3], rotations[4], cov3d[6], colors[3], sh_dc[3];

  SceneGradient<V> pointers(const Scene<T>& s) {
    return {means, means2d, opacities, scales, rotations, s.cov3d ? cov3d : nullptr, colors, sh_dc, nullptr};
  }

  void write(const Pack<T>& pack, const SceneGradient<T>& out) {
    const auto write = [&](V* values, int row, T* to) {
      if (to) write_rows(values, row, row, pack, to);
    };
    write(means, 3, out.means), write(means2d, 3, out.means2d), write(opacities, 1, out.opacities);
    write(scales, 3, out.scales), write(rotations, 4, out.rotations), write(cov3d, 6, out.cov3d);
    write(colors, 3, out.colors), write(sh_dc, 3, out.sh_dc);
  }
};

// At most kVjpBlock Gaussians.
template <class T, class AnyCamera>
GS_ONE_COPY void project_vjp_rows(const Scene<T>& s, const AnyCamera& camera, const int32_t* tile_counts,
                                  const T* moments, const SceneGradient<T>& out) {
  using V = typename Simd<T>::Vec;
  int32_t seen[kVjpBlock];
  for_packs<T>(seen, list_seen(s, tile_counts, out, seen), [&](const Pack<T>& pack) {
    constexpr int kRow = kGradientRow<kOnRays<AnyCamera>>;
    V m[kRow], rest[kMostRest];
    read_rows(moments, kRow, s.count, kRow, pack, m);
    SceneLanes<T> row(s, pack);
    row.read_colors(s, pack, rest);
    PackGradient<T> gradient{};
    project_vjp_row(s, camera, row, m, rest, rest, gradient.pointers(s), 0);
    gradient.write(pack, out);
    if (out.sh_rest) write_rows(rest, 3 * s.rest_bands, 3 * s.rest_bands, pack, out.sh_rest);
  });
}

}  // namespace

// In a file of its own, as project_on_rays.
template <class T>
void project_vjp_on_rays(const Scene<T>& s, const RayCamera<T>& camera, const int32_t* tile_counts, const T* moments,
                         const SceneGradient<T>& out);
template <class T>
void project_vjp_on_rays(const Scene<T>& s, const LensRayCamera<T>& camera, const int32_t* tile_counts,
                         const T* moments, const SceneGradient<T>& out);

GS_ISA_END
