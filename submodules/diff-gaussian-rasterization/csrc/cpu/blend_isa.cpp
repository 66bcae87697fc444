// Blending, and the decisive splats, by EWA and on the rays of pinholes.
#include "blend_tiles.h"

GS_ISA_BEGIN

template <class T>
void mark_decisive(const Executor& executor, const BlendInput<T>& in, const int32_t* last, bool* decisive) {
  const int64_t tiles = tiles_of(in.image);
  if (in.rays == kLensRays) return mark_lens_rays(executor, in, last, decisive);
  const auto run = in.rays ? mark_tile<T, kPinholeRays> : mark_tile<T, kNoRays>;
  for_dynamic(executor, tiles, 1, [&](int64_t tile, int64_t) { run(in, last, tile, decisive); });
}

template <class T>
void blend(const Executor& executor, const BlendInput<T>& in, const Blended<T>& out) {
  if (in.rays == kLensRays) return blend_lens_rays(executor, in, out);
  (in.rays ? blend_tiles<T, kPinholeRays> : blend_tiles<T, kNoRays>)(executor, in, out);
}

#define GS_INSTANTIATE(T)                                                           \
  template void blend<T>(const Executor&, const BlendInput<T>&, const Blended<T>&); \
  template void mark_decisive<T>(const Executor&, const BlendInput<T>&, const int32_t* last, bool* decisive);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
