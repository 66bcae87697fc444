// Functions of every row by itself.
#include "../math/elementary.h"

#include "../backend.h"

namespace gs {

namespace {
constexpr int64_t kGrain = 4096;
}

void elementary(const Executor& executor, const Elementary& in) {
  executor.run(in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) elementary(in, i);
  });
}

void random_words(const Executor& executor, const RandomInput& in) {
  executor.run(in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) random_words(in, i);
  });
}

}  // namespace gs
