#pragma once
// A splat, a Gaussian projected to the image, and the number of values in its rows.
#include "gs/isa.h"

GS_ISA_BEGIN

// A row of the tensor `splats`: all that blending needs.
template <class T>
struct Splat {
  T x, y;           // mean, px, pixel centres at integers
  T l11, l12, l22;  // factor of the conic, log2 units (footprint.h)
  T log2_opacity;   // antialiasing included
  T r, g, b;
  T inverse_depth;  // 1 / view z
};
constexpr int kSplatValues = 10;

// Gradient sums of a splat over its pixels: moments of the exponent (footprint.h), then colour and inverse depth.
constexpr int kGradientValues = 10;  // q, qu, qv, quu, quv, qvv, r, g, b, inverse depth

GS_ISA_END
