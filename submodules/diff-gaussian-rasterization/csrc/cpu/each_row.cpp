// Functions of every row by itself.
#include "../backend.h"
#include "../math/displace.h"
#include "../math/elementary.h"
#include "../math/observe.h"

namespace gs {

void displace(const Executor& executor, const Displacement& in) {
  if (in.stopped && *in.stopped) return;
  for_each_row(executor, in.count, 1024, [&](int64_t i) { displace(in, i); });
}

// Computes exp or log of every value, rounded alike on every machine.
void elementary(const Executor& executor, const Elementary& in) {
  for_each_row(executor, in.count, 4096, [&](int64_t i) { elementary(in, i); });
}

void random_words(const Executor& executor, const RandomInput& in) {
  for_each_row(executor, in.count, 4096, [&](int64_t i) { random_words(in, i); });
}

void observe(const Executor& executor, const ObserveInput& in) {
  for_each_row(executor, in.count, 16384, [&](int64_t i) { observe(in, i, i); });
}

}  // namespace gs
