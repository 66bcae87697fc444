#pragma once
// The forward of blending in images of few tiles.
#include "backend.h"

namespace gs {
namespace cuda {

void blend_chunks(const Queue& queue, const BlendInput<float>& in, const Blended<float>& out);

}  // namespace cuda
}  // namespace gs
