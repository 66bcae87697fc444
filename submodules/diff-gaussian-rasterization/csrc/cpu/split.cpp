// Places the children of split Gaussians.
#include "../math/split.h"

#include "../backend.h"

namespace gs {

void split_positions(const Executor& executor, const SplitInput& in) {
  constexpr int64_t kGrain = 1024;
  executor.run(in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) split_position(in, i);
  });
}

}  // namespace gs
