// Describes splats by the values that programs for gsplat read.
#include "../math/describe.h"

#include "../backend.h"

namespace gs {

template <class T>
void describe(const Executor& executor, const DescribeInput<T>& in, const Descriptions<T>& out) {
  executor.run(in.count, 4096, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) baseline::describe_splat(in, out, i);
  });
}

template void describe<float>(const Executor&, const DescribeInput<float>&, const Descriptions<float>&);
template void describe<double>(const Executor&, const DescribeInput<double>&, const Descriptions<double>&);

}  // namespace gs
