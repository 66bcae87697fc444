#pragma once
// Arithmetic that gives the same bits on a GPU and on every CPU. Compilers fuse a product with a sum wherever the
// machine can. On the host, build_extension.py turns that off for sources that are compiled once. So a formula that
// uses this belongs into one of those, not into a *_isa.cpp.
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
GS_HD double rounded_product(double a, double b) {
#ifdef __CUDA_ARCH__
  return __dmul_rn(a, b);
#else
  return a * b;
#endif
}

}  // namespace gs
