#pragma once
// Every threshold of the method, once. Values are the reference's (CONTRACT: what users observe).
#include "gs/isa.h"

GS_ISA_BEGIN

constexpr int kTile = 16;                // pixels a side
constexpr double kNear = 0.2;            // view-space z at or below: culled (markVisible has the same rule)
constexpr double kDilation = 0.3;        // px^2 added to both variances: a splat covers a pixel at least
constexpr double kJacobianClamp = 1.3;   // in units of the half image; beyond, the affine approximation explodes
constexpr double kMinAlpha = 1.0 / 255;  // less is not blended
constexpr double kLog2MinAlpha = -7.994353436858857938;  // log2 of the above
constexpr double kMaxAlpha = 0.99;                       // the gradient passes this cap
constexpr double kMinTransmittance = 1e-4;  // a splat that would leave less ends the pixel and is not blended
constexpr double kMinAntialias = 2.5e-5;    // floor of det/det dilated: compensation is at least 0.005
constexpr double kRadiusSigmas = 3;         // `radii` and visibility, not which pixels are reached
constexpr double kMinRadiusRoot = 0.1;      // px^4, under the root of the larger eigenvalue
constexpr double kMaxLog2Opacity = 64;      // opacities are at most 1; this only keeps exp2 finite for others
constexpr double kBlack = -1e-6;    // a colour from here on has a gradient: black points start at 0 but for rounding
constexpr double kMaxColor = 1e15;  // a larger magnitude is culled like Inf: its gradients overflow
constexpr double kMinQuaternion = 1e-30;  // shorter counts as zero: its gradient, 1/|q|, overflows
constexpr double kLn2 = 0.693147180559945309417;
constexpr double kHalfLog2e = 0.5 / kLn2;  // exp(-q/2) = exp2(-kHalfLog2e q)

GS_ISA_END
