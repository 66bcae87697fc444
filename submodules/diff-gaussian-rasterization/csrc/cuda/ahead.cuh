#pragma once
// Lets the host run ahead: the device compares what lists need with the room that the host gave them.
#include "../data.h"
#include "queue.cuh"

namespace gs {
namespace cuda {

// Notes the lengths of the lists, and halts if there is less room.
__device__ inline void judge_lists(const Ahead& ahead, int64_t instances, int64_t slots) {
  if (is_halted(ahead.halted)) return;
  *ahead.needed = {instances, slots, 0};
  if (instances > ahead.room.instances || slots > ahead.room.slots) *ahead.halted = ahead.step;
}

// Does the same for the gradient rows, and tells the host. The step's number arrives last.
__device__ inline void judge_rows(const Ahead& ahead, int64_t rows) {
  Room& needed = *ahead.needed;
  if (!is_halted(ahead.halted)) {
    needed.rows = rows;
    if (needed.rows > ahead.room.rows) *ahead.halted = ahead.step;
  }
  if (!ahead.report) return;
  volatile int64_t* to = ahead.report;
  to[0] = needed.instances, to[1] = needed.slots, to[2] = needed.rows, to[3] = *ahead.halted;
  __threadfence_system();
  to[4] = ahead.step;
}

}  // namespace cuda
}  // namespace gs
