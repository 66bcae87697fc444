#pragma once
// Threads of the host framework: csrc/torch passes torch's pool to a backend, a C++ test a serial executor.
#include <atomic>
#include <cstdint>
#include <functional>

namespace gs {

struct Executor {
  int threads;  // the number of bodies that may run at once
  // Calls body(begin, end) on ranges that cover [0, n). The cut depends on the number of threads, so a body's result
  // must not depend on the cut.
  void (*run)(int64_t n, int64_t grain, const std::function<void(int64_t, int64_t)>& body);
};

inline void run_serially(int64_t n, int64_t /*grain*/, const std::function<void(int64_t, int64_t)>& body) {
  if (n > 0) body(0, n);
}
inline Executor serial_executor() { return {1, &run_serially}; }

// Calls body(row) for each of n rows, of which a thread takes `grain` or more at a time.
template <class Body>
void for_each_row(const Executor& executor, int64_t n, int64_t grain, const Body& body) {
  executor.run(n, grain, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) body(row);
  });
}

// Calls body(begin, end) on blocks of fixed size; each free thread takes the next block. For uneven work.
template <class Body>
void for_dynamic(const Executor& executor, int64_t n, int64_t block, const Body& body) {
  const int64_t blocks = (n + block - 1) / block;
  std::atomic<int64_t> next{0};
  const int64_t workers = blocks < executor.threads ? blocks : executor.threads;
  executor.run(workers, 1, [&](int64_t, int64_t) {
    for (int64_t b; (b = next.fetch_add(1, std::memory_order_relaxed)) < blocks;)
      body(b * block, (b + 1) * block < n ? (b + 1) * block : n);
  });
}

}  // namespace gs
