// The tiles of a splat against every pixel centre of the image, evaluated as blending evaluates it.
#include <random>
#include <vector>

#include "cpu/list_tiles.h"
#include "gs/check.h"
#include "gs/simd.h"
#include "math/blend.h"
#include "math/footprint.h"

using namespace gs::GS_ISA;

namespace {

std::mt19937 generator(3);
double normal() { return std::normal_distribution<double>()(generator); }
double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(generator); }

constexpr int kWidth = 75, kHeight = 53;

// The largest exponent over the pixel centres of each tile.
template <class T>
std::vector<T> brute_force(const Splat<T>& splat) {
  const int columns = tile_count(kWidth), rows = tile_count(kHeight);
  std::vector<T> best(columns * rows, -1e30f);
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x) {
      const int tx = x / kTile, ty = y / kTile;
      const LocalSplat<T> local = localise(splat, T(tx * kTile), T(ty * kTile));
      const RowTerms<T> terms = row_terms(local, T(y - ty * kTile));
      const T t = row_exponent(terms, row_u(terms, T(x - tx * kTile)));
      T& here = best[ty * columns + tx];
      here = larger(here, t);
    }
  return best;
}

template <class T>
Splat<T> random_splat(double longest) {
  const double angle = uniform(0, 3.14159265358979), c = std::cos(angle), s = std::sin(angle);
  const double major = std::pow(10, uniform(-2, std::log10(longest))), minor = std::pow(10, uniform(-3, 1));
  const Vec3<T> m1 = {T(c * major), T(-s * minor), 0}, m2 = {T(s * major), T(c * minor), 0};
  const Footprint<T> f = make_footprint(m1, m2, Vec3<T>{0, 0, T(major * minor)});
  Splat<T> splat = {};
  splat.x = T(uniform(-30, kWidth + 30)), splat.y = T(uniform(-30, kHeight + 30));
  splat.l11 = f.l11, splat.l12 = f.l12, splat.l22 = f.l22;
  splat.log2_opacity = T(-0.3 * normal() * normal());
  return splat;
}

template <class T>
std::vector<bool> listed(const Splat<T>& splat) {
  std::vector<bool> out(tile_count(kWidth) * tile_count(kHeight), false);
  int previous = -1;
  std::vector<int32_t> tiles(out.size());
  const TileRect rect = tile_rect(splat, kWidth, kHeight);
  uint64_t mask, same;
  tiles.resize(list_tiles(splat, rect, gs::Image{kWidth, kHeight}, mask, tiles.data()));
  CHECK(list_tiles(splat, rect, gs::Image{kWidth, kHeight}, same, nullptr) == int(tiles.size()) && mask == same);
  CHECK(__builtin_popcountll(mask) == int(tiles.size()));
  for (int tile : tiles) {
    const int x = tile % tile_count(kWidth) - rect.x0, y = tile / tile_count(kWidth) - rect.y0;
    CHECK(mask >> (y * (rect.x1 - rect.x0) + x) & 1);
  }
  const TileTest<T> test = make_tile_test(splat, rect, kWidth, kHeight);
  for (int tile : tiles) {
    CHECK(tile > previous);  // row by row, each tile once
    CHECK(tile < int(out.size()));
    CHECK(tile_reached(test, T(tile % tile_count(kWidth)), T(tile / tile_count(kWidth))));  // alone as in a vector
    previous = tile;
    out[tile] = true;
  }
  return out;
}

// Returns the number of tiles listed without need; none may be missing.
template <class T>
int check(const Splat<T>& splat) {
  const std::vector<T> best = brute_force(splat);
  const std::vector<bool> tiles = listed(splat);
  int spare = 0;
  for (size_t i = 0; i < best.size(); ++i) {
    const bool reached = best[i] >= T(kLog2MinAlpha);
    CHECK(!reached || tiles[i]);
    spare += tiles[i] && !reached;
  }
  return spare;
}

template <class T>
void test_random() {
  int spare = 0, total = 0;
  for (int trial = 0; trial < 1500; ++trial) {
    const Splat<T> splat = random_splat<T>(trial % 2 ? 30 : 3000);
    spare += check(splat);
    for (bool tile : listed(splat)) total += tile;
  }
  CHECK(total > 2000);
  // Needles pass between the pixel centres of a tile's box. Measured: 4 of 2,595.
  CHECK(spare < 10);
}

// row_reached never denies a pixel that the exponent reaches, alone and in vectors, also where opacity just suffices.
template <class T>
void test_rows() {
  using S = Simd<T>;
  int reached = 0, spare = 0;
  for (int trial = 0; trial < 4000; ++trial) {
    Splat<T> splat = random_splat<T>(trial % 2 ? 30 : 3000);
    const LocalSplat<T> local = localise(splat, T(16), T(16));
    for (int y = 0; y < kTile; ++y)
      for (int first = 0; first < kTile; first += 8) {
        RowTerms<T> terms = row_terms(local, T(y));
        T best = -INFINITY;
        for (int x = first; x < first + 8; ++x) best = larger(best, row_exponent(terms, row_u(terms, T(x))));
        if (trial % 3 == 0) terms.top += T(kLog2MinAlpha) - best;  // up to rounding
        best = -INFINITY;
        for (int x = first; x < first + 8; ++x) best = larger(best, row_exponent(terms, row_u(terms, T(x))));
        const bool kept = row_reached(terms, T(first), T(first + 7));
        const RowTerms<typename S::Vec> all = {S::all(terms.top), S::all(terms.l11), S::all(terms.u0), {}};
        CHECK(S::bits(row_reached(all, T(first), T(first + 7))) == (kept ? (1u << S::kLanes) - 1 : 0));
        CHECK(kept || !(best >= T(kLog2MinAlpha)));
        reached += best >= T(kLog2MinAlpha), spare += kept && !(best >= T(kLog2MinAlpha)) && trial % 3;
      }
  }
  CHECK(reached > 5000);
  CHECK(spare < reached / 20);  // thin splats that pass between pixel centres
}

// Opacities within a few units in the last place of the one that just reaches 1/255 in a tile.
template <class T>
void test_borderline() {
  int reached = 0, not_reached = 0;
  for (int trial = 0; trial < 1500; ++trial) {
    Splat<T> splat = random_splat<T>(trial % 2 ? 30 : 3000);
    splat.log2_opacity = 0;
    const std::vector<T> best = brute_force(splat);
    const size_t tile = size_t(trial) % best.size();
    if (best[tile] < -7 || best[tile] > -1e-3) continue;
    splat.log2_opacity = T(kLog2MinAlpha) - best[tile];
    for (int step = int(trial / best.size()) % 7 - 3; step != 0; step += step < 0 ? 1 : -1)
      splat.log2_opacity = std::nextafter(splat.log2_opacity, T(step < 0 ? -20 : 20));
    check(splat);
    ++(brute_force(splat)[tile] >= T(kLog2MinAlpha) ? reached : not_reached);
  }
  CHECK(reached > 20);
  CHECK(not_reached > 20);
}

template <class T>
void test_extremes() {
  const T infinity = std::numeric_limits<T>::infinity(), nan = std::numeric_limits<T>::quiet_NaN();
  Splat<T> splat = random_splat<T>(3);
  splat.x = splat.y = 20;
  splat.log2_opacity = T(kLog2MinAlpha) - T(0.1);
  CHECK(listed(splat) == std::vector<bool>(listed(splat).size(), false));
  splat.log2_opacity = nan;
  CHECK(listed(splat) == std::vector<bool>(listed(splat).size(), false));
  // So wide that every tile is reached; so far away that none is; coordinates that no integer holds.
  splat.log2_opacity = 0;
  splat.l11 = splat.l22 = T(1e-12), splat.l12 = 0;
  CHECK(listed(splat) == std::vector<bool>(listed(splat).size(), true));
  splat.l11 = splat.l22 = 1;
  for (T x : {T(1e30), T(-1e30), infinity, -infinity, nan}) {
    splat.x = x;
    CHECK(listed(splat) == std::vector<bool>(listed(splat).size(), false));
  }
  CHECK(clamped_floor(T(1e30), 7) == 7);
  CHECK(clamped_floor(T(-1e30), 7) == 0);
  CHECK(clamped_floor(infinity, 7) == 7);
  CHECK(clamped_floor(nan, 7) == 0);
  CHECK(clamped_floor(T(6.99), 7) == 6);
}

// The reference's tiles of a square: from int((x - r) / 16) to int((x + r + 15) / 16), exclusive, clamped to the grid.
void test_radius() {
  const auto on = [](double x, double y, int radius) { return radius_on_image(x, y, radius, 64, 32); };
  CHECK(on(10, 10, 3));
  CHECK(on(-3 + 1.5, 10, 3));
  CHECK(!on(-19, 10, 3));
  CHECK(on(66.5, 10, 3));
  CHECK(!on(67, 10, 3));
  CHECK(!on(10, 35, 3));
  CHECK(on(1e9, -1e9, 1 << 30));
}

// A splat local to its tile keeps the exponent that image coordinates would lose.
void test_local_coordinates() {
  Splat<float> splat = {};
  splat.x = 3999.37f, splat.y = 8.2f, splat.l11 = 1.5f, splat.l12 = 0.3f, splat.l22 = 1.2f;
  for (int x = 3984; x < 4000; ++x) {
    const RowTerms<float> terms = row_terms(localise(splat, 3984.0f, 0.0f), 9.0f);
    const double got = row_exponent(terms, row_u(terms, float(x - 3984)));
    const double dx = x - double(splat.x), dy = 9 - double(splat.y);
    const double u = double(splat.l11) * dx + double(splat.l12) * dy, v = double(splat.l22) * dy;
    // Terms of up to 24 with 2^-24 each, times 2 u.
    CHECK_NEAR(got, -(u * u + v * v), 48 * 6e-8 * (2 * std::abs(u) + 1));
  }
}

}  // namespace

int main() {
  test_random<float>(), test_random<double>();
  test_rows<float>(), test_rows<double>();
  test_borderline<float>(), test_borderline<double>();
  test_extremes<float>(), test_extremes<double>();
  test_radius();
  test_local_coordinates();
  return gs::finish_tests("rasterizer tiles");
}
