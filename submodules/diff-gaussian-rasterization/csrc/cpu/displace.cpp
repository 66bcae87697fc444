// Moves Gaussians at random.
#include "../math/displace.h"

#include "../backend.h"

namespace gs {

void displace(const Executor& executor, const Displacement& in) {
  if (in.stopped && *in.stopped) return;
  constexpr int64_t kGrain = 1024;
  executor.run(in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) displace(in, i);
  });
}

}  // namespace gs
