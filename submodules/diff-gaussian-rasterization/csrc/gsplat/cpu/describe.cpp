// What programs for gsplat give and read: cameras, and splats.
#include "gsplat/math/describe.h"

#include "gsplat/backend.h"

namespace gs {

template <class T>
void describe(const Executor& executor, const DescribeInput<T>& in, const Descriptions<T>& out) {
  for_each_row(executor, in.count, 4096, [&](int64_t i) { baseline::describe_splat(in, out, i); });
}

template <class T>
void describe_vjp(const Executor& executor, const DescribedInput<T>& in, const DescribedGradient<T>& out) {
  for_each_row(executor, in.count, 4096, [&](int64_t i) { baseline::describe_vjp_splat(in, out, i); });
}

template <class T>
void pinhole(const Executor&, const T* pose, const T* intrinsics, Image image, const PinholeMatrices<T>& out) {
  baseline::make_pinhole(pose, intrinsics, image, out);
}

template <class T>
int64_t list_shown(const Executor&, const DescribeInput<T>& in, int64_t* rows) {
  int64_t shown = 0;
  for (int64_t i = 0; i < in.count; ++i)
    if (baseline::extent_of(in, i, baseline::shape_of(in, i)).shown) rows[shown++] = i;
  return shown;
}

#define GS_INSTANTIATE(T)                                                                                \
  template void describe<T>(const Executor&, const DescribeInput<T>&, const Descriptions<T>&);           \
  template int64_t list_shown<T>(const Executor&, const DescribeInput<T>&, int64_t*);                    \
  template void describe_vjp<T>(const Executor&, const DescribedInput<T>&, const DescribedGradient<T>&); \
  template void pinhole<T>(const Executor&, const T*, const T*, Image, const PinholeMatrices<T>&);
GS_INSTANTIATE(float)
GS_INSTANTIATE(double)

}  // namespace gs
