#pragma once
#include <cstring>

#include "gs/hd.h"
#include "gs/isa.h"

GS_ISA_BEGIN

// A struct of 16 bytes by one load, for which nvcc would take one for each part of a member's size.
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
