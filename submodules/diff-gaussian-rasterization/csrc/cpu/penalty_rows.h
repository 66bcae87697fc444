#pragma once
// Penalties of a block of Gaussians, for the op and for the backward that takes steps itself.
#include "../data.h"
#include "gs/isa.h"
#include "one_copy.h"

GS_ISA_BEGIN

// Adds the penalty's gradients. A null pointer to gradients leaves them out.
template <class T>
GS_ONE_COPY void penalise_rows(const PenaltyInput<T>& in);

GS_ISA_END
