#pragma once
// The functions that every backend offers for gsplat's.
#include "../backend.h"
#include "data.h"

namespace gs {

template <class T>
void describe(const Executor&, const DescribeInput<T>&, const Descriptions<T>&);
// Writes the numbers of the splats that are shown, ascending. Returns how many there are.
template <class T>
int64_t list_shown(const Executor&, const DescribeInput<T>&, int64_t* rows);
template <class T>
void describe_vjp(const Executor&, const DescribedInput<T>&, const DescribedGradient<T>&);
template <class T>
void pinhole(const Executor&, const T* pose, const T* intrinsics, Image, const PinholeMatrices<T>&);

namespace cuda {
void describe(const Queue&, const DescribeInput<float>&, const Descriptions<float>&);
int64_t list_shown(const Queue&, const DescribeInput<float>&, int64_t* rows);
void describe_vjp(const Queue&, const DescribedInput<float>&, const DescribedGradient<float>&);
// In float64 as well.
template <class T>
void pinhole(const Queue&, const T* pose, const T* intrinsics, Image, const PinholeMatrices<T>&);
}  // namespace cuda
using cuda::describe, cuda::describe_vjp, cuda::list_shown, cuda::pinhole;

}  // namespace gs
