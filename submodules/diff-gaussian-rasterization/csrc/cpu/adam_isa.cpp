#include "../launch.h"
#include "../math/adam.h"

GS_ISA_BEGIN

namespace {

template <class T>
void adam_tensor(const Executor& executor, const AdamInput<T>& in) {
  if (in.columns == 0) return;
  const AdamStep<T> step = make_adam_step<T>(in.lr, in.beta1, in.beta2, in.eps, in.step);
  const bool dense = in.columns == in.row;
  // Fixed blocks, not the pool's: the compiler's vector loop and its scalar tail may round differently.
  const int64_t n = dense ? in.rows * in.row : in.rows;
  for_dynamic(executor, n, dense ? 32768 : 1024, [&](int64_t begin, int64_t end) {
    const auto run = [&](int64_t first, int64_t count) {
      T* __restrict value = in.value + first;
      T* __restrict mean = in.mean + first;
      T* __restrict square = in.square + first;
      const T* __restrict gradient = in.gradient + first;
      for (int64_t i = 0; i < count; ++i) gs::GS_ISA::adam(step, gradient[i], value[i], mean[i], square[i]);
    };
    if (dense) return run(begin, end - begin);
    for (int64_t r = begin; r < end; ++r) run(r * in.row, in.columns);
  });
}

}  // namespace

template <class T>
void adam(const Executor& executor, const AdamInput<T>* tensors, int64_t count) {
  for (int64_t i = 0; i < count; ++i) adam_tensor(executor, tensors[i]);
}

template void adam<float>(const Executor&, const AdamInput<float>*, int64_t);
template void adam<double>(const Executor&, const AdamInput<double>*, int64_t);

GS_ISA_END
