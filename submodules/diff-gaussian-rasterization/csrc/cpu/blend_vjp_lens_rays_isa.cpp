// The backward of blending on the rays of a lens.
#include "blend_vjp_tiles.h"

GS_ISA_BEGIN

template <class T>
void blend_vjp_lens_rays(const Executor& executor, const BlendInput<T>& in, const BlendGradient<T>& g) {
  (g.absolute ? sum_gradients<T, kLensRays, true> : sum_gradients<T, kLensRays, false>)(executor, in, g);
}

#define GS_INSTANTIATE(T) \
  template void blend_vjp_lens_rays<T>(const Executor&, const BlendInput<T>&, const BlendGradient<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
