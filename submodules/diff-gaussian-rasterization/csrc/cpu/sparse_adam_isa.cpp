#include "../launch.h"
#include "../math/adam.h"

GS_ISA_BEGIN

template <class T>
void sparse_adam(const Executor& executor, const AdamInput<T>& in, const bool* visible) {
  const AdamStep<T> step = make_uncorrected_adam_step<T>(in.lr, in.beta1, in.beta2, in.eps);
  // Row by row: where a vector loop ends and its scalar tail begins must not depend on which rows are visible.
  for_dynamic(executor, in.rows, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r) {
      if (!visible[r]) continue;
      const int64_t first = r * in.row;
      T* __restrict value = in.value + first;
      T* __restrict mean = in.mean + first;
      T* __restrict square = in.square + first;
      const T* __restrict gradient = in.gradient + first;
      for (int64_t i = 0; i < in.columns; ++i) adam(step, gradient[i], value[i], mean[i], square[i]);
    }
  });
}

template void sparse_adam<float>(const Executor&, const AdamInput<float>&, const bool*);
template void sparse_adam<double>(const Executor&, const AdamInput<double>&, const bool*);

GS_ISA_END
