#pragma once
// A load that nvcc does not split.
#include <cstring>

#include "gs/hd.h"
#include "gs/isa.h"

GS_ISA_BEGIN

// Loads a struct of 16 bytes at once; nvcc alone would load it member by member.
template <class T>
GS_HD T load_whole(const T* from) {
  static_assert(sizeof(T) == 16 && alignof(T) == 16);
#ifdef __CUDA_ARCH__
  const int4 bits = *reinterpret_cast<const int4*>(from);
  T value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
#else
  return *from;
#endif
}

GS_ISA_END
