#pragma once
// What a step notes of rows that may wait (math/lazy_rows.h).
#include "../math/lazy_rows.h"

GS_ISA_BEGIN

// Whether row i takes the step of a view that reaches so many tiles by it.
template <class T>
bool steps_now(const LazyRows<T>& rows, int64_t i, int32_t tiles) {
  return tiles || rows.last[i] == kEveryStep;
}

// Whether all values of row i may wait.
template <class T>
bool row_may_wait(const AdamInput<T>* attributes, int64_t i) {
  bool all = true;
  for (int a = 0; a < kLazy; ++a) {
    const AdamInput<T>& in = attributes[a];
    const int64_t first = i * in.row;
    for (int64_t k = first; k < first + in.columns; ++k) all &= may_wait(in.value[k], in.mean[k], in.square[k]);
  }
  return all;
}

// Notes which of the rows [first, first + count) took the step.
template <class T>
void note_rows(const GaussianStep<T>& step, const int32_t* tile_counts, int64_t first, int64_t count) {
  for (int64_t i = first; i < first + count; ++i)
    if (steps_now(step.lazy, i, tile_counts[i]))
      step.lazy.last[i] = row_may_wait(step.attributes + kFirstLazy, i) ? step.number : kEveryStep;
}

// Notes that the step was taken, with these constants of all attributes.
template <class T>
void note_step(const GaussianStep<T>& step, const AdamStep<T>* constants) {
  for (int a = 0; a < kLazy; ++a) store_step(constants[kFirstLazy + a], step.lazy.ring + ring_place(step.number, a));
  *step.lazy.taken = step.number;
}

GS_ISA_END
