#pragma once
// The instances that a backward of blending walks over: those up to the last one that a pixel of their tile has
// blended.
#include "backend.h"
#include "cuda/blend/schedule.cuh"
#include "gradient_rows.cuh"

namespace gs {
namespace cuda {

struct Processed {
  RowPlaces places;        // of their rows
  const int32_t* lengths;  // (tiles) of each list's part
  Schedule schedule;       // of its chunks
  int64_t rows;            // or more
};

// exact: whether the host waits for the number of rows, even if they are few.
Processed find_processed(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g,
                         int32_t chunk_size, bool exact);

}  // namespace cuda
}  // namespace gs
