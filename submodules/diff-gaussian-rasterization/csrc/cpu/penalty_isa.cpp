// Adds the gradients of penalties, a vector at a time.
#include <algorithm>

#include "../backend.h"
#include "../math/penalty.h"
#include "step_rows.h"

GS_ISA_BEGIN

namespace {

constexpr int64_t kBlock = 1024;  // Gaussians

// gradients[k] = function(gradients[k], values[k])
template <class T, class Function>
void for_values(int64_t count, const T* values, T* gradients, const Function& function) {
  using S = Simd<T>;
  for (int64_t i = 0; i < count; i += S::kLanes) {
    T value[S::kLanes] = {}, gradient[S::kLanes] = {};
    const int64_t n = std::min<int64_t>(S::kLanes, count - i);
    std::copy_n(values + i, n, value), std::copy_n(gradients + i, n, gradient);
    S::store(gradient, function(S::load(gradient), S::load(value)));
    std::copy_n(gradient, n, gradients + i);
  }
}

}  // namespace

template <class T>
void penalise_rows(const PenaltyInput<T>& in) {
  using V = typename Simd<T>::Vec;
  if (in.logit_gradients)
    for_values(in.count, in.logits, in.logit_gradients,
               [&](V gradient, V logit) { return with_opacity_penalty(gradient, in.penalty.opacity, logit); });
  if (in.log_scale_gradients)
    for_values(3 * in.count, in.log_scales, in.log_scale_gradients,
               [&](V gradient, V log_scale) { return with_scale_penalty(gradient, in.penalty.scale, log_scale); });
}

template <class T>
void penalise(const Executor& executor, const PenaltyInput<T>& in) {
  for_dynamic(executor, in.count, kBlock, [&](int64_t begin, int64_t end) {
    penalise_rows<T>({end - begin, in.penalty, in.logits + begin, in.log_scales + 3 * begin, in.logit_gradients + begin,
                      in.log_scale_gradients + 3 * begin});
  });
}

#define GS_INSTANTIATE(T)                                 \
  template void penalise_rows<T>(const PenaltyInput<T>&); \
  template void penalise<T>(const Executor&, const PenaltyInput<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

GS_ISA_END
