#pragma once
// Lets the host run ahead: the device compares what lists need with the room that the host gave them.
#include "data.h"
#include "queue.cuh"

namespace gs {
namespace cuda {

// Notes the number of blocks that are awake, and halts if there is less room for them. It is the first to judge.
__device__ inline void judge_blocks(const Ahead& ahead, int64_t blocks) {
  if (is_halted(ahead.halted)) return;
  *ahead.needed = {0, 0, 0, blocks};
  if (blocks > ahead.room.blocks) *ahead.halted = int32_t(*ahead.done + 1);
}

// Does the same for the lengths of the lists.
__device__ inline void judge_lists(const Ahead& ahead, int64_t instances, int64_t slots) {
  if (is_halted(ahead.halted)) return;
  *ahead.needed = {instances, slots, 0, ahead.needed->blocks};
  if (instances > ahead.room.instances || slots > ahead.room.slots) *ahead.halted = int32_t(*ahead.done + 1);
}

// Does the same for the gradient rows, and tells the host. The step's number arrives last. The steps that follow a
// halted one write its report once more.
__device__ inline void judge_rows(const Ahead& ahead, int64_t rows) {
  Room& needed = *ahead.needed;
  const int64_t step = *ahead.done + 1;
  if (!is_halted(ahead.halted)) {
    needed.rows = rows;
    if (rows > ahead.room.rows)
      *ahead.halted = int32_t(step);
    else
      *ahead.done = step;
  }
  if (!ahead.reports) return;
  volatile int64_t* to = ahead.reports + 6 * (step % ahead.report_count);
  to[0] = needed.instances, to[1] = needed.slots, to[2] = needed.rows, to[3] = needed.blocks, to[4] = *ahead.halted;
  __threadfence_system();
  to[5] = step;
}

}  // namespace cuda
}  // namespace gs
