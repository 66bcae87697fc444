#pragma once
// The run-ahead of the calling thread (gs::Ahead), which the op `run_ahead_` sets for the ops that follow.
#include "data.h"

namespace gs::ops {

// Null: the host waits for the lengths of lists.
const gs::Ahead* ahead();

// The word at which kernels do nothing (gs::Queue::halted), or null.
inline const int32_t* halted() { return ahead() ? ahead()->halted : nullptr; }

}  // namespace gs::ops
