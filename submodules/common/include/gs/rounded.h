#pragma once
// For arithmetic that gives the same bits on a GPU and on every CPU: compilers fuse a product with the sum it goes into
// wherever the machine can. On the host that is off in sources that are compiled once (build_extension.py), so a
// formula that uses this belongs into one of those, not into a *_isa.cpp.
#include "gs/hd.h"

namespace gs {

// a * b, rounded before anything is added to it.
GS_HD float rounded_product(float a, float b) {
#ifdef __CUDA_ARCH__
  return __fmul_rn(a, b);
#else
  return a * b;
#endif
}

}  // namespace gs
