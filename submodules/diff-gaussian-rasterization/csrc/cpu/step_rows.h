#pragma once
// Adam's steps and penalties of rows, for their ops and for the backward that takes steps itself.
#include "../data.h"
#include "../math/adam.h"

GS_ISA_BEGIN

// Takes the step of `count` rows from row `first` on; `gradient` has their gradients, and in.gradient is not read.
// Returns whether all values took their step; without a guard it does not look.
template <class T>
bool adam_rows(const AdamStep<T>& step, const AdamInput<T>& in, const T* gradient, int64_t first, int64_t count,
               bool guarded);

// Adds the penalties' gradients. A null pointer to gradients leaves them out.
template <class T>
GS_ONE_COPY void penalise_rows(const PenaltyInput<T>& in);

// The constants of an input's step.
template <class T>
AdamStep<T> adam_step_of(const AdamInput<T>& in, bool sparse) {
  return sparse ? make_uncorrected_adam_step<T>(in.lr, in.beta1, in.beta2, in.eps)
                : make_adam_step<T>(in.lr, in.beta1, in.beta2, in.eps, in.step);
}

// Calls body(first, count) on every run of consecutive rows in [begin, end) that is_visible selects. Returns whether
// all calls did.
template <class IsVisible, class Body>
bool for_runs(int64_t begin, int64_t end, const IsVisible& is_visible, const Body& body) {
  bool all = true;
  for (int64_t first = begin; first < end;) {
    if (!is_visible(first)) {
      ++first;
      continue;
    }
    int64_t behind = first + 1;
    while (behind < end && is_visible(behind)) ++behind;
    all &= body(first, behind - first);
    first = behind;
  }
  return all;
}

GS_ISA_END
