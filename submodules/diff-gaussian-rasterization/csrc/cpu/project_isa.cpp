// Projection, by threads.
#include "project_rows.h"

GS_ISA_BEGIN

template <class T>
void project(const Executor& executor, const Scene<T>& s, const Projected<T>& out) {
  const int64_t block = s.awake ? kSleepBlock : kProjectBlock;
  with_any_camera(s, [&](const auto& camera) {
    for_dynamic(executor, s.count, block, [&](int64_t begin, int64_t end) {
      if (s.awake && !s.awake[begin / block])
        cull_all(end - begin, part_of(out, begin));
      else if constexpr (kOnRays<std::decay_t<decltype(camera)>> != kNoRays)
        project_on_rays(part_of(s, begin, end - begin), camera, part_of(out, begin));
      else
        project_block(part_of(s, begin, end - begin), camera, part_of(out, begin));
    });
  });
}

#define GS_INSTANTIATE(T) template void project<T>(const Executor&, const Scene<T>&, const Projected<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
