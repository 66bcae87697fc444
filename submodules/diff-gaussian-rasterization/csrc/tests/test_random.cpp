// Philox's published answers, and the portable functions against long double.
#include <limits>

#include "gs/check.h"
#include "math/random.h"

namespace {

void test_philox() {
  const uint32_t most = 0xffffffffu;
  const struct {
    gs::RandomWords counter;
    uint64_t seed;
    gs::RandomWords answer;
  } known[] = {
      // published with Random123
      {{{0, 0, 0, 0}}, 0, {{0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8}}},
      {{{most, most, most, most}}, ~0ull, {{0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd}}},
      {{{0x243f6a88, 0x85a308d3, 0x13198a2e, 0x03707344}},
       0x299f31d0a4093822,
       {{0xd16cfe09, 0x94fdcceb, 0x5001e420, 0x24126ea1}}},
  };
  for (const auto& k : known) {
    const gs::RandomWords got = gs::philox(k.counter, k.seed);
    for (int i = 0; i < 4; ++i) CHECK(got.w[i] == k.answer.w[i]);
  }
}

void test_portable_functions() {
  CHECK(gs::portable::exp(701) == gs::portable::exp(700) && gs::portable::exp(-INFINITY) == gs::portable::exp(-700));
  CHECK(std::isnan(gs::portable::exp(std::numeric_limits<double>::quiet_NaN())));
  if (!gs::kLongDoubleIsWider) return;
  for (double x = -700; x <= 700; x += 0.0731)
    CHECK_NEAR(double(gs::portable::exp(x) / std::exp((long double)x)), 1, 4 * 0x1p-53);
  for (double x = 1e-300; x < 1e300; x *= 1.37) {
    const double wanted = double(std::log((long double)x));
    CHECK_NEAR(gs::portable::log(x), wanted, 1e-15 * std::fmax(1, std::abs(wanted)));
  }
  for (int64_t turns = 0; turns < int64_t(1) << 32; turns += 1000003) {
    const long double angle = turns * (2 * 3.14159265358979323846264L / 4294967296.0L);
    const gs::portable::CosSin got = gs::portable::cos_sin_turns(uint32_t(turns));
    CHECK_NEAR(got.cos, double(std::cos(angle)), 4e-16);
    CHECK_NEAR(got.sin, double(std::sin(angle)), 4e-16);
  }
}

}  // namespace

int main() {
  test_philox();
  test_portable_functions();
  return gs::finish_tests("random numbers");
}
