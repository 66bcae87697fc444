// Wakes blocks of Gaussians.
#include <algorithm>
#include <cstring>
#include <numeric>
#include <type_traits>

#include "../backend.h"
#include "../math/adam.h"
#include "../math/sleep.h"
#include "scene_lanes.h"
#include "step_rows.h"

GS_ISA_BEGIN

namespace {

// Whether a view may show one of the Gaussians.
template <class T, class AnyCamera>
bool may_be_seen(const Scene<T>& s, const Watch<AnyCamera>& watch) {
  using S = Simd<T>;
  int32_t rows[kSleepBlock];
  std::iota(rows, rows + s.count, 0);
  for (int64_t first = 0; first < s.count; first += S::kLanes) {
    bool seen = false;
    for_packs<T>(rows + first, std::min<int64_t>(S::kLanes, s.count - first), [&](const Pack<T>& pack) {
      typename S::Vec scales[3];
      read_rows(s.scales, 3, s.count, 3, pack, scales);
      const typename S::Vec largest = larger(larger(scales[0], scales[1]), scales[2]) + watch.log_scale;
      const typename S::Mask unseen =
          surely_unseen(watch, read_means(s, pack), typename S::Vec(s.scale_modifier * exponential(largest)));
      seen = S::bits(~unseen) & ((1u << pack.count) - 1);
    });
    if (seen) return true;
  }
  return false;
}

template <class T>
void take_missed_of_block(const AdamInput<T>& to, const MissedSum<T>& missed, int64_t first, int64_t rows) {
  for (int64_t r = first; r < first + rows; ++r)
    for (int64_t at = r * to.row; at < r * to.row + to.columns; ++at)
      take_missed(missed, to.value[at], to.mean[at], to.square[at]);
}

template <class T>
AdamStep<T> step_of(const GaussianStep<T>& in, int attribute) {
  AdamStep<T> step = adam_step_of(in.attributes[attribute], false);
  if constexpr (std::is_same_v<T, float>)
    if (in.now) std::memcpy(&step, in.now->constants[attribute], sizeof step);
  return step;
}

}  // namespace

template <class T>
void wake(const Executor& executor, const Scene<T>& s, const SleepInput<T>& in) {
  const GaussianStep<T>& step = in.step;
  if (step.guard.stopped && *step.guard.stopped) return;
  const int64_t number = step.now ? step.now->step : int64_t(step.attributes[kStepMeans].step);
  MissedSums<T> sums = {};
  for (int64_t k = 0; k < kTerms; ++k) sums.set_decays(step.attributes[kStepMeans], number, k);
  for (int a = 0; a < kStepped; ++a)
    if (step.attributes[a].columns) {
      const AdamStep<T> constants = step_of(step, a);
      in.terms[number % kTerms * kTermColumns + a] = constants.rate / constants.root_correction;
      sums.add_up(step.attributes[a], in.terms, a, number);
    }
  with_camera(s, [&](const auto& camera) {
    for_dynamic(executor, s.count, kSleepBlock, [&](int64_t begin, int64_t end) {
      const int64_t block = begin / kSleepBlock, missed = missed_before(number, in.taken[block]);
      const auto reach = [&](int a) { return missed > 0 ? sums.reach(a, missed) : T(0); };
      const bool wakes =
          in.all || missed < 0 ||
          may_be_seen(part_of(s, begin, end - begin),
                      Watch<std::decay_t<decltype(camera)>>(camera, reach(kStepMeans), reach(kStepScales)));
      for (int a = 0; a < kStepped && wakes && missed > 0; ++a)
        take_missed_of_block(step.attributes[a], sums.of(a, missed), begin, end - begin);
      in.awake[block] = wakes;
      if (wakes) in.taken[block] = int32_t(number - in.rests);
    });
  });
}

#define GS_INSTANTIATE(T) template void wake<T>(const Executor&, const Scene<T>&, const SleepInput<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
