#pragma once
#include "../launch.h"
#include "compact.cuh"

namespace gs {
namespace cuda {

// The backward of blending up to the rows of each processed instance. Waits for their number where they may be many.
Compact blend_rows(const Queue& queue, const BlendInput<float>& in, const BlendGradient<float>& g);

}  // namespace cuda
}  // namespace gs
