// The steps that lazy rows lack.
#include <algorithm>

#include "../backend.h"
#include "../math/scene_row.h"
#include "gs/simd.h"
#include "lazy_rows.h"

GS_ISA_BEGIN

namespace {

constexpr int64_t kGrain = 512;

// The steps that a row lacks, for one of its attributes.
template <class T>
struct Late {
  const T* ring;
  int attribute;
  int32_t last, taken;

  void take(T* value, T* mean, T* square) const {
    using S = Simd<T>;
    typename S::Vec v = S::load(value), m = S::load(mean), s = S::load(square);
    if (!S::any(((typename S::Mask)m | (typename S::Mask)s) != 0)) return;
    take_late_steps<S>(ring, attribute, last, taken, v, m, s);
    S::store(value, v), S::store(mean, m), S::store(square, s);
  }

  // The last values of a row, fewer than a vector's.
  void take_tail(T* value, T* mean, T* square, int64_t count) const {
    constexpr int kLanes = Simd<T>::kLanes;
    T v[kLanes] = {}, m[kLanes] = {}, s[kLanes] = {};
    std::copy_n(value, count, v), std::copy_n(mean, count, m), std::copy_n(square, count, s);
    take(v, m, s);
    std::copy_n(v, count, value), std::copy_n(m, count, mean), std::copy_n(s, count, square);
  }
};

template <class T>
void catch_up_row(const CatchUp<T>& in, int64_t i, int32_t taken) {
  constexpr int kLanes = Simd<T>::kLanes;
  for (int a = 0; a < kLazy; ++a) {
    const AdamInput<T>& at = in.attributes[a];
    const Late<T> late{in.rows.ring, a, in.rows.last[i], taken};
    const int64_t end = i * at.row + at.columns;
    int64_t k = i * at.row;
    for (; k + kLanes <= end; k += kLanes) late.take(at.value + k, at.mean + k, at.square + k);
    if (k < end) late.take_tail(at.value + k, at.mean + k, at.square + k, end - k);
  }
  in.rows.last[i] = row_may_wait(in.attributes, i) ? taken : kEveryStep;
}

}  // namespace

template <class T>
void catch_up(const Executor& executor, const Scene<T>& s, const CatchUp<T>& in) {
  const Camera<T> camera = in.all ? Camera<T>{} : camera_of(s);
  const int32_t taken = *in.rows.taken;
  for_dynamic(executor, s.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const int32_t last = in.rows.last[i];
      if (last >= 0 && last < taken && (in.all || may_be_seen(s, camera, i))) catch_up_row(in, i, taken);
    }
  });
}

template void catch_up<float>(const Executor&, const Scene<float>&, const CatchUp<float>&);
template void catch_up<double>(const Executor&, const Scene<double>&, const CatchUp<double>&);

GS_ISA_END
