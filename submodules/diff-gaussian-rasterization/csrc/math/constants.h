#pragma once
// Every threshold of the method, once. The values are the reference's, because users observe them.
#include "gs/isa.h"

GS_ISA_BEGIN

constexpr int kTile = 16;                // pixels a side
constexpr double kJacobianClamp = 1.3;   // half images; beyond, the affine approximation explodes
constexpr double kSleepTurn = 0.1;       // radians that a fisheye's direction may have turned: _TURN in lens.py
constexpr double kPole = 1e-3;           // least angle from the poles of a panorama, radians
constexpr double kMinAlpha = 1.0 / 255;  // a smaller alpha is not blended
constexpr double kLog2MinAlpha = -7.994353436858857938;  // log2 of the above
constexpr double kMaxAlpha = 0.99;                       // the gradient passes this cap
constexpr double kMinTransmittance = 1e-4;  // a splat that would leave less ends the pixel and is not blended
constexpr double kRadiusSigmas = 3;         // for `radii` and visibility, not for which pixels are reached
constexpr double kMinRadiusRoot = 0.1;      // px^4, under the root of the larger eigenvalue
constexpr double kMaxLog2Opacity = 64;      // opacities are at most 1; this keeps exp2 finite for others
constexpr double kBlack = -1e-6;    // colours >= this get a gradient: points that start black are at 0 up to rounding
constexpr double kMaxColor = 1e15;  // a larger magnitude is culled as Inf is: its gradients overflow
constexpr double kMaxVariance = 1e36;     // px^2; culled beyond, for any T: in float32 the squares overflow
constexpr double kMinQuaternion = 1e-30;  // a shorter one counts as zero: its gradient, 1/|q|, overflows
constexpr double kPi = 3.14159265358979323846;
constexpr double kLn2 = 0.693147180559945309417;
constexpr double kHalfLog2e = 0.5 / kLn2;  // exp(-q/2) = exp2(-kHalfLog2e q)

GS_ISA_END
