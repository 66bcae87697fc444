// Projection of Gaussians on rays, and its backward.
#include "project_rows.h"
#include "project_vjp_rows.h"

GS_ISA_BEGIN

template <class T>
void project_on_rays(const Scene<T>& s, const RayCamera<T>& camera, const Projected<T>& out) {
  project_block(s, camera, out);
}

template <class T>
void project_vjp_on_rays(const Scene<T>& s, const RayCamera<T>& camera, const int32_t* tile_counts, const T* moments,
                         const SceneGradient<T>& out) {
  project_vjp_rows(s, camera, tile_counts, moments, out);
}

#define GS_INSTANTIATE(T)                                                                              \
  template void project_on_rays<T>(const Scene<T>&, const RayCamera<T>&, const Projected<T>&);         \
  template void project_vjp_on_rays<T>(const Scene<T>&, const RayCamera<T>&, const int32_t*, const T*, \
                                       const SceneGradient<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
