#pragma once
// What the backends implement.
#include <cstdint>

#include "gs/cuda_queue.h"
#include "gs/parallel.h"

namespace gs {

// out[i] = mean squared distance of point i to the nearest three of the other points, or as many as there are
// (none: 0). Points with a coordinate that is not finite have no neighbours and are nobody's.
// points: n x 3, contiguous. T: float or double.
template <class T>
void mean_distance2_cpu(const T* points, int64_t n, T* out, const Executor& executor);
// n < 2^31; points and out on the device. Waits for the stream once.
template <class T>
void mean_distance2_cuda(const T* points, int64_t n, T* out, const Queue& queue);

}  // namespace gs
