// Adam's steps, dense, sparse and missed, under a guard.
#include <algorithm>
#include <vector>

#include "../backend.h"
#include "gs/simd.h"
#include "step_rows.h"

GS_ISA_BEGIN

namespace {

// Values of one or several tensors that lie side by side.
template <class T>
struct Values {
  const T* gradient;
  T *value, *mean, *square;
};

// Steps a vector of values; those that are not `mine` stay as they are. `finite` loses the lanes that did not take
// their step.
template <class T, bool kGuarded, bool kPart = false>
void step_lanes(const AdamStep<T>& step, const Values<T>& at, typename Simd<T>::Mask& finite,
                typename Simd<T>::Mask mine = typename Simd<T>::Mask{}) {
  using S = Simd<T>;
  const typename S::Vec gradient = S::load(at.gradient);
  const typename S::Vec old_value = S::load(at.value), old_mean = S::load(at.mean), old_square = S::load(at.square);
  typename S::Vec value = old_value, mean = old_mean, square = old_square;
  if constexpr (kGuarded) {
    const typename S::Mask taken = adam_if_finite<S>(step, gradient, value, mean, square);
    finite &= kPart ? taken | ~mine : taken;
  } else {
    gs::GS_ISA::adam<S>(step, gradient, value, mean, square);
  }
  if constexpr (kPart) value = mine ? value : old_value, mean = mine ? mean : old_mean;
  if constexpr (kPart) square = mine ? square : old_square;
  S::store(at.value, value), S::store(at.mean, mean), S::store(at.square, square);
}

// The last values, fewer than a vector's: copies are stepped, beside lanes that cannot fail.
template <class T, bool kGuarded>
void step_tail(const AdamStep<T>& step, const Values<T>& at, int64_t count, typename Simd<T>::Mask& finite) {
  constexpr int kLanes = Simd<T>::kLanes;
  T gradient[kLanes] = {}, value[kLanes] = {}, mean[kLanes] = {}, square[kLanes];
  std::fill_n(square, kLanes, T(1));
  for (int64_t k = 0; k < count; ++k)
    gradient[k] = at.gradient[k], value[k] = at.value[k], mean[k] = at.mean[k], square[k] = at.square[k];
  step_lanes<T, kGuarded>(step, {gradient, value, mean, square}, finite);
  for (int64_t k = 0; k < count; ++k) at.value[k] = value[k], at.mean[k] = mean[k], at.square[k] = square[k];
}

// The first lanes of a vector.
template <class T>
typename Simd<T>::Mask first_lanes(int64_t count) {
  typename Simd<T>::Mask mask;
  for (int k = 0; k < Simd<T>::kLanes; ++k) mask[k] = k < count ? -1 : 0;
  return mask;
}

// room: how many values lie there, `count` or more. In a vector those behind the first `count` may be read, and written
// back as they were: many times as fast as copies.
template <class T, bool kGuarded>
bool step_values(const AdamStep<T>& step, const Values<T>& at, int64_t count, int64_t room) {
  typename Simd<T>::Mask finite = ~typename Simd<T>::Mask{};
  int64_t i = 0;
  const auto from = [&] { return Values<T>{at.gradient + i, at.value + i, at.mean + i, at.square + i}; };
  for (; i + Simd<T>::kLanes <= count; i += Simd<T>::kLanes) step_lanes<T, kGuarded>(step, from(), finite);
  if (i < count && i + Simd<T>::kLanes <= room)
    step_lanes<T, kGuarded, true>(step, from(), finite, first_lanes<T>(count - i));
  else if (i < count)
    step_tail<T, kGuarded>(step, from(), count - i, finite);
  return !Simd<T>::any(~finite);
}

// Steps `count` values from value `first` of the tensor on; `gradient` has theirs. room: of step_values.
template <class T>
bool adam_values(const AdamStep<T>& step, const AdamInput<T>& in, const T* gradient, int64_t first, int64_t count,
                 int64_t room, bool guarded) {
  const Values<T> at{gradient, in.value + first, in.mean + first, in.square + first};
  return guarded ? step_values<T, true>(step, at, count, room) : step_values<T, false>(step, at, count, room);
}

template <class T>
bool adam_tensor(const Executor& executor, const AdamInput<T>& in, bool guarded) {
  if (in.columns == 0) return true;
  const AdamStep<T> step = adam_step_of(in, false);
  const bool dense = in.columns == in.row;
  bool finite = true;
  for_dynamic(executor, dense ? in.rows * in.row : in.rows, dense ? 32768 : 1024, [&](int64_t begin, int64_t end) {
    const bool mine = dense ? adam_values(step, in, in.gradient + begin, begin, end - begin, end - begin, guarded)
                            : adam_rows(step, in, in.gradient + begin * in.row, begin, end - begin, guarded);
    if (!mine) __atomic_store_n(&finite, false, __ATOMIC_RELAXED);
  });
  return finite;
}

}  // namespace

template <class T>
bool adam_rows(const AdamStep<T>& step, const AdamInput<T>& in, const T* gradient, int64_t first, int64_t count,
               bool guarded) {
  const int64_t all = count * in.row;
  if (in.columns == in.row) return adam_values(step, in, gradient, first * in.row, all, all, guarded);
  bool finite = true;
  for (int64_t r = 0; r < count; ++r)
    finite &= adam_values(step, in, gradient + r * in.row, (first + r) * in.row, in.columns, in.row, guarded);
  return finite;
}

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
  const AdamStep<T> step = adam_step_of(in, in.step == 0);
  bool finite = may_step(guard);
  for_dynamic(executor, finite ? in.rows : 0, 1024, [&](int64_t begin, int64_t end) {
    const bool mine = for_runs(
        begin, end, [&](int64_t r) { return visible[r]; },
        [&](int64_t r, int64_t rows) {
          return adam_rows(step, in, in.gradient + r * in.row, r, rows, guard.stopped != nullptr);
        });
    if (!mine) __atomic_store_n(&finite, false, __ATOMIC_RELAXED);
  });
  if (!finite && *guard.stopped == 0) *guard.stopped = guard.iteration;
}

#define GS_INSTANTIATE(T)                                                                                \
  template bool adam_rows<T>(const AdamStep<T>&, const AdamInput<T>&, const T*, int64_t, int64_t, bool); \
  template void adam<T>(const Executor&, const AdamInput<T>*, int64_t, const StepGuard<T>&);             \
  template void sparse_adam<T>(const Executor&, const AdamInput<T>&, const bool*, const StepGuard<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
