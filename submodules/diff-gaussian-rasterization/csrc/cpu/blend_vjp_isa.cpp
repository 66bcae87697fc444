// The backward of blending, by EWA and on the rays of pinholes.
#include "blend_vjp_tiles.h"

GS_ISA_BEGIN

namespace {

// Calls run(rays, absolute) with constants.
template <class Run>
void by_kind(Rays rays, bool absolute, const Run& run) {
  const std::true_type yes;
  const std::false_type no;
  const std::integral_constant<int, kPinholeRays> on_rays;
  const std::integral_constant<int, kNoRays> flat;
  if (rays)
    absolute ? run(on_rays, yes) : run(on_rays, no);
  else
    absolute ? run(flat, yes) : run(flat, no);
}

}  // namespace

template <class T>
void blend_vjp(const Executor& executor, const BlendInput<T>& in, const BlendGradient<T>& g) {
  if (in.rays == kLensRays) return blend_vjp_lens_rays(executor, in, g);
  by_kind(in.rays, g.absolute, [&](auto rays, auto absolute) { sum_gradients<T, rays, absolute>(executor, in, g); });
}

template <class T>
void blend_rows(const Executor& executor, const BlendInput<T>& in, const BlendGradient<T>& g,
                const RowMemory<T>& memory) {
  by_kind(in.rays, memory.absolute,
          [&](auto rays, auto absolute) { keep_rows<T, rays, absolute>(executor, in, g, memory); });
}

template <class T>
void sum_rows(const Executor& executor, const SplatRows<T>& in, const RowSums<T>& to) {
  by_kind(in.rays, to.absolute, [&](auto rays, auto absolute) { sum_given<T, rays, absolute>(executor, in, to); });
}

#define GS_INSTANTIATE(T)                                                                                           \
  template void blend_vjp<T>(const Executor&, const BlendInput<T>&, const BlendGradient<T>&);                       \
  template void blend_rows<T>(const Executor&, const BlendInput<T>&, const BlendGradient<T>&, const RowMemory<T>&); \
  template void sum_rows<T>(const Executor&, const SplatRows<T>&, const RowSums<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
