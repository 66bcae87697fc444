#pragma once
// Replaces the header of this name: a kernel runs at its launch; see emulation.h.
#include <cstdint>

#include "emulation.h"
#include "gs/cuda_check.h"
#include "gs/cuda_queue.h"

namespace gs {

inline bool begin_work(const int32_t* halted) { return !(halted && *halted != 0); }

template <class... Parameters, class... Arguments>
void launch(const Queue& queue, const char*, void (*kernel)(const int32_t*, Parameters...), unsigned blocks,
            unsigned threads, const Arguments&... arguments) {
  emulation::run_grid(blocks, threads, 0, [&] { kernel(queue.halted, arguments...); });
}

}  // namespace gs
