// Adds noise to the centres of Gaussians.
#include "../math/noise.h"

#include "../backend.h"

namespace gs {

void add_noise(const Executor& executor, const NoiseInput& in) {
  if (in.stopped && *in.stopped) return;
  constexpr int64_t kGrain = 1024;
  executor.run(in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) add_noise_to(in, i);
  });
}

}  // namespace gs
