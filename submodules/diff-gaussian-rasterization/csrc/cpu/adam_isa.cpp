// Adam's steps, dense and sparse, under a guard.
#include <type_traits>

#include "../backend.h"
#include "../math/adam.h"

GS_ISA_BEGIN

namespace {

// Steps `count` values of a tensor from `first` on. Returns whether all took their step.
template <class T>
bool adam_values(const AdamStep<T>& step, const AdamInput<T>& in, int64_t first, int64_t count, bool guarded) {
  T* __restrict value = in.value + first;
  T* __restrict mean = in.mean + first;
  T* __restrict square = in.square + first;
  const T* __restrict gradient = in.gradient + first;
  std::conditional_t<sizeof(T) == 4, int32_t, int64_t> wrong = 0;  // as wide as T, so that the loop vectorises
  if (guarded) {
    for (int64_t i = 0; i < count; ++i)
      wrong |= adam_if_finite(step, gradient[i], value[i], mean[i], square[i]) ? 0 : 1;
  } else {
    for (int64_t i = 0; i < count; ++i) gs::GS_ISA::adam(step, gradient[i], value[i], mean[i], square[i]);
  }
  return wrong == 0;
}

template <class T>
bool adam_tensor(const Executor& executor, const AdamInput<T>& in, bool guarded) {
  if (in.columns == 0) return true;
  const AdamStep<T> step = make_adam_step<T>(in.lr, in.beta1, in.beta2, in.eps, in.step);
  const bool dense = in.columns == in.row;
  bool finite = true;
  // Fixed blocks, not the pool's ranges: the compiler's vector loop and its scalar tail may round differently.
  const int64_t n = dense ? in.rows * in.row : in.rows;
  for_dynamic(executor, n, dense ? 32768 : 1024, [&](int64_t begin, int64_t end) {
    bool mine = true;
    if (dense) mine = adam_values(step, in, begin, end - begin, guarded);
    for (int64_t r = begin; r < end && !dense; ++r) mine &= adam_values(step, in, r * in.row, in.columns, guarded);
    if (!mine) __atomic_store_n(&finite, false, __ATOMIC_RELAXED);
  });
  return finite;
}

}  // namespace

template <class T>
void adam(const Executor& executor, const AdamInput<T>* tensors, int64_t count, const StepGuard<T>& guard) {
  bool finite = may_step(guard);
  if (finite) {
    for (int64_t i = 0; i < count; ++i) finite &= adam_tensor(executor, tensors[i], guard.stopped != nullptr);
  }
  if (!finite && *guard.stopped == 0) *guard.stopped = guard.iteration;
}

template <class T>
void sparse_adam(const Executor& executor, const AdamInput<T>& in, const bool* visible, const StepGuard<T>& guard) {
  const AdamStep<T> step = make_uncorrected_adam_step<T>(in.lr, in.beta1, in.beta2, in.eps);
  bool finite = may_step(guard);
  // Row by row: the end of a vector loop, where its scalar tail begins, must not depend on which rows are visible.
  for_dynamic(executor, finite ? in.rows : 0, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r)
      if (visible[r] && !adam_values(step, in, r * in.row, in.columns, guard.stopped != nullptr))
        __atomic_store_n(&finite, false, __ATOMIC_RELAXED);
  });
  if (!finite && *guard.stopped == 0) *guard.stopped = guard.iteration;
}

template void adam<float>(const Executor&, const AdamInput<float>*, int64_t, const StepGuard<float>&);
template void adam<double>(const Executor&, const AdamInput<double>*, int64_t, const StepGuard<double>&);
template void sparse_adam<float>(const Executor&, const AdamInput<float>&, const bool*, const StepGuard<float>&);
template void sparse_adam<double>(const Executor&, const AdamInput<double>&, const bool*, const StepGuard<double>&);

GS_ISA_END
