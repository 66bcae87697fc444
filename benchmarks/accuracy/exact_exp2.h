#pragma once
// Replaces csrc/math/exp2.h in the build that benchmarks/accuracy/exact_exponential.py makes: the same functions, but
// each lane is computed by the standard library's exponential.
#include <cmath>
#include <cstring>

#include "gs/hd.h"
#include "gs/isa.h"

GS_ISA_BEGIN

template <class V, class T>
inline V exp2_by_library(V t) {
  T lanes[sizeof(V) / sizeof(T)];
  std::memcpy(lanes, &t, sizeof t);
  for (T& lane : lanes) lane = std::exp2(lane);
  std::memcpy(&t, lanes, sizeof t);
  return t;
}

// Within 0.51 units in the last place with glibc.
template <class V, class I>
inline V exp2_lanes(V t, float) {
  return exp2_by_library<V, float>(t);
}
template <class V, class I>
inline V exp2_lanes(V t, double) {
  return exp2_by_library<V, double>(t);
}

// CUDA's exp2f is the fast instruction with a wider range, so take the double function and round once.
GS_HD float exp2_device(float t) { return float(std::exp2(double(t))); }

GS_ISA_END
