// Blending on the rays of a lens.
#include "blend_tiles.h"

GS_ISA_BEGIN

template <class T>
void blend_lens_rays(const Executor& executor, const BlendInput<T>& in, const Blended<T>& out) {
  blend_tiles<T, kLensRays>(executor, in, out);
}

template <class T>
void mark_lens_rays(const Executor& executor, const BlendInput<T>& in, const int32_t* last, bool* decisive) {
  for_dynamic(executor, tiles_of(in.image), 1,
              [&](int64_t tile, int64_t) { mark_tile<T, kLensRays>(in, last, tile, decisive); });
}

#define GS_INSTANTIATE(T)                                                                     \
  template void blend_lens_rays<T>(const Executor&, const BlendInput<T>&, const Blended<T>&); \
  template void mark_lens_rays<T>(const Executor&, const BlendInput<T>&, const int32_t*, bool*);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
