#pragma once
// Three threads that share the work of a test.
#include <thread>
#include <vector>

#include "gs/parallel.h"

namespace gs {

inline Executor three_threads() {
  return {3, [](int64_t n, int64_t, const std::function<void(int64_t, int64_t)>& body) {
            std::vector<std::thread> running;
            for (int64_t i = 0; i < 3; ++i)
              if (n * i / 3 < n * (i + 1) / 3) running.emplace_back([&, i] { body(n * i / 3, n * (i + 1) / 3); });
            for (std::thread& thread : running) thread.join();
          }};
}

}  // namespace gs
