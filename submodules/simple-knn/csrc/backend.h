#pragma once
// The functions that the backends offer.
#include <cstdint>

#include "gs/cuda_queue.h"
#include "gs/parallel.h"

namespace gs {

// out[i] = mean squared distance of point i to the nearest three other points, or to fewer where there are fewer; 0
// where there is none. A point with a coordinate that is not finite has no neighbours and is no neighbour.
// points: n x 3, contiguous. T: float or double.
template <class T>
void mean_distance2(const T* points, int64_t n, T* out, const Executor& executor);
// n < 2^31; points and out on the device. Waits for the stream once.
template <class T>
void mean_distance2(const T* points, int64_t n, T* out, const Queue& queue);

}  // namespace gs
