// Adds a view to the statistics of density control.
#include "../math/observe.h"

#include "../backend.h"

namespace gs {

void observe(const Executor& executor, const ObserveInput& in) {
  constexpr int64_t kGrain = 16384;
  executor.run(in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      Observed o{in.max_radii[i], in.gradient_sums[i], in.views[i]};
      if (in.lengths)
        observe(in.radii[i], in.lengths[i], o);
      else
        observe(in.radii[i], in.gradients[3 * i], in.gradients[3 * i + 1], o);
      in.max_radii[i] = o.max_radius, in.gradient_sums[i] = o.gradient_sum, in.views[i] = o.views;
    }
  });
}

}  // namespace gs
