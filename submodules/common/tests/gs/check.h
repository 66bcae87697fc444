#pragma once
// The macros of the C++ tests: a failure reports file, line and both values; the test continues and exits with 1.
#include <cmath>
#include <iostream>

namespace gs {

inline int& failures() {
  static int count = 0;
  return count;
}

inline int finish_tests(const char* name) {
  std::cout << name << ": " << (failures() ? "FAILED" : "passed") << '\n';
  return failures() ? 1 : 0;
}

}  // namespace gs

#define CHECK(condition)                                                               \
  do {                                                                                 \
    if (!(condition)) {                                                                \
      ++gs::failures();                                                                \
      std::cerr << __FILE__ << ':' << __LINE__ << ": " << #condition << " is false\n"; \
    }                                                                                  \
  } while (0)

// Checks |got - wanted| <= tolerance; NaN fails.
#define CHECK_NEAR(got, wanted, tolerance)                                                                \
  do {                                                                                                    \
    const double got_ = (got), wanted_ = (wanted), tolerance_ = (tolerance);                              \
    if (!(std::abs(got_ - wanted_) <= tolerance_)) {                                                      \
      ++gs::failures();                                                                                   \
      std::cerr << __FILE__ << ':' << __LINE__ << ": " << #got << " = " << got_ << ", wanted " << wanted_ \
                << " within " << tolerance_ << '\n';                                                      \
    }                                                                                                     \
  } while (0)
