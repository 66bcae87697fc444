// The early test for Gaussians outside of the image, against the whole projection; and Gaussians on rays: derivatives,
// and what they reach.
#include <random>

#include "gs/check.h"
#include "math/ray.h"
#include "math/ray_pixels.h"

using namespace gs::GS_ISA;

namespace {

std::mt19937 generator(2);
double normal() { return std::normal_distribution<double>()(generator); }
double uniform(double low, double high) { return std::uniform_real_distribution<double>(low, high)(generator); }

constexpr int kWidth = 64, kHeight = 48;

Camera<double> camera(double principal_x, double principal_y) {
  double norm;
  Vec3<double> c[3];
  rotation_columns(normalise(Quat<double>{0.9, 0.2, -0.3, 0.1}, norm), c);
  const double tan_x = 0.6, tan_y = 0.45, t[3] = {0.1, -0.2, 0.3}, center[3] = {0, 0, 0};
  // View and full projection, transposed; columns of the rotation become rows here.
  double view[16] = {}, full[16] = {};
  const double r[3][3] = {{c[0].x, c[0].y, c[0].z}, {c[1].x, c[1].y, c[1].z}, {c[2].x, c[2].y, c[2].z}};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) view[4 * i + j] = r[i][j];
  for (int j = 0; j < 3; ++j) view[12 + j] = t[j];
  view[15] = 1;
  for (int i = 0; i < 4; ++i) {
    full[4 * i] = view[4 * i] / tan_x + principal_x * view[4 * i + 2];
    full[4 * i + 1] = view[4 * i + 1] / tan_y + principal_y * view[4 * i + 2];
    full[4 * i + 3] = view[4 * i + 2];
  }
  return make_camera(view, full, center, tan_x, tan_y, kWidth, kHeight, gs::kUsualNear);
}

bool reaches_image(Splat<double>& splat) {
  const TileRect rect = tile_rect(splat, kWidth, kHeight, false);
  return rect.x1 > rect.x0;
}

// Pixel by pixel: the rectangle of a splat that passes the camera's plane is the whole image.
bool reaches_image(const RaySplat<double>& splat) {
  for (int y = 0; y < kHeight; ++y) {
    const auto row = row_terms(localise(splat, 0.0, 0.0), double(y));
    for (int x = 0; x < kWidth; ++x)
      if (exponent_at(row, double(x)) >= kLog2MinAlpha) return true;
  }
  return false;
}

// What is surely outside has neither tile nor radius, at full opacity; and most of what has none is found.
template <class AnyCamera, class AnySplat>
void test_surely_outside(const AnyCamera& cam) {
  int outside = 0, empty = 0;
  for (int trial = 0; trial < 10000; ++trial) {
    Gaussian<double> g = {{}, {{}, {}, gs::dilation_of<double>(gs::kUsualDilation)}, 0};
    g.mean = {4 * normal(), 4 * normal(), 4 * normal()};
    double norm, largest = 0;
    rotation_columns(normalise(Quat<double>{normal(), normal(), normal(), normal()}, norm), g.axes.direction);
    for (double& scale : g.axes.scale) scale = std::exp(uniform(-7, 2)), largest = larger(largest, scale);
    g.log2_opacity = 0;
    AnySplat splat;
    double depth;
    int radius;
    const bool visible = project_splat(cam, g, false, splat, depth, radius);
    const bool nothing = radius == 0 && !(visible && reaches_image(splat)),
               found = surely_outside(cam, g.mean, [&] { return largest; });
    CHECK(nothing || !found);
    empty += nothing, outside += found;
  }
  CHECK(outside > 0.8 * empty);
  CHECK(empty < 9500);
}

// A large Gaussian in front of the camera, or around it; one of five is flat.
Gaussian<double> large_gaussian() {
  Gaussian<double> g = {{}, {{}, {}, gs::dilation_of<double>(gs::kUsualDilation)}, 0};
  double norm;
  g.mean = {normal(), normal(), 3 + normal()};
  rotation_columns(normalise(Quat<double>{normal(), normal(), normal(), normal()}, norm), g.axes.direction);
  for (double& scale : g.axes.scale) scale = std::exp(uniform(-4, 1));
  if (uniform(0, 1) < 0.2) g.axes.scale[2] = 0;
  g.log2_opacity = -0.5;
  return g;
}

// ln(alpha) at a pixel, and the sums of this pixel alone.
double log_alpha(const RayCamera<double>& cam, const Gaussian<double>& g, int x, int y, RayMoments<double>& m) {
  RaySplat<double> splat;
  double depth;
  int radius;
  if (!project_splat(cam, g, false, splat, depth, radius)) return -INFINITY;
  const int left = x / kTile * kTile, top = y / kTile * kTile;
  const RayRow<double> row = row_terms(localise(splat, double(left), double(top)), double(y - top));
  const AtPixel<double> at = at_pixel(row, double(x - left));
  const RayWeights<double> r = ray_weights(row, at, splat.slope_v);
  m = {{1, r.au, r.av, r.u * r.u, r.u * r.v, r.v * r.v}, r.p * r.u, r.p * r.v, r.p * r.p};
  RayRowSums<double> sums;
  sums.add(at, 1);
  const RayMoments<double> same = sums.moments(row, splat.slope_v);
  double largest = 0;
  for (int k = 0; k < 9; ++k) largest = larger(largest, std::abs((&m.on_image.q)[k]));
  for (int k = 0; k < 9; ++k) CHECK_NEAR((&same.on_image.q)[k], (&m.on_image.q)[k], 1e-9 * largest);
  return kLn2 * row_exponent(row, at);
}

void test_gradients_on_rays() {
  const RayCamera<double> cam{camera(0.05, -0.1)};
  int tried = 0;
  while (tried < 200) {
    Gaussian<double> g = large_gaussian();
    const int x = int(uniform(0, kWidth)), y = int(uniform(0, kHeight));
    RayMoments<double> m, other;
    if (to_view(cam, g.mean).z < 0.3 || log_alpha(cam, g, x, y, m) < -5) continue;
    ++tried;
    const auto found = project_splat_vjp(cam, g, false, false, static_cast<double*>(nullptr), m, 0.0);
    const auto check = [&](double& value, double gradient) {
      const double step = 1e-6, before = value;
      value = before + step;
      const double high = log_alpha(cam, g, x, y, other);
      value = before - step;
      const double low = log_alpha(cam, g, x, y, other);
      value = before;
      CHECK_NEAR((high - low) / (2 * step), gradient, 1e-6 * (1 + std::abs(gradient)));  // third derivatives
    };
    check(g.mean.x, found.mean.x), check(g.mean.y, found.mean.y), check(g.mean.z, found.mean.z);
    for (int k = 0; k < 3; ++k) {
      check(g.axes.direction[k].x, found.direction[k].x), check(g.axes.direction[k].z, found.direction[k].z);
      if (g.axes.scale[k] > 0) check(g.axes.scale[k], found.log_scale[k] / g.axes.scale[k]);
    }
  }
}

// A pixel that is reached lies in a tile of the rectangle that is reached, and its row is.
void test_reach_on_rays() {
  const RayCamera<double> cam{camera(0.05, -0.1)};
  int reached = 0, tested = 0, listed = 0;
  for (int trial = 0; trial < 3000; ++trial) {
    RaySplat<double> splat;
    double depth;
    int radius;
    if (!project_splat(cam, large_gaussian(), false, splat, depth, radius)) continue;
    const TileRect rect = tile_rect(splat, kWidth, kHeight, false);
    const auto test = make_tile_test(splat, rect, kWidth, kHeight);
    for (int ty = 0; ty < tile_count(kHeight); ++ty)
      for (int tx = 0; tx < tile_count(kWidth); ++tx) {
        const bool inside = tx >= rect.x0 && tx < rect.x1 && ty >= rect.y0 && ty < rect.y1;
        const bool lists = inside && tile_reached(test, double(tx), double(ty));
        const auto local = localise(splat, double(tx * kTile), double(ty * kTile));
        bool any_pixel = false;
        for (int y = 0; y < kTile; ++y) {
          const auto row = row_terms(local, double(y));
          bool any_here = false;
          for (int x = 0; x < kTile; ++x) any_here |= exponent_at(row, double(x)) >= kLog2MinAlpha;
          CHECK(!any_here || row_reached(row, 0.0, double(kTile - 1)));
          any_pixel |= any_here;
        }
        CHECK(!any_pixel || lists);
        reached += any_pixel, listed += lists, ++tested;
      }
  }
  CHECK(reached > 1000 && reached < 0.8 * tested);
  CHECK(listed < 1.1 * reached);
}

}  // namespace

int main() {
  const Camera<double> plain = camera(0.05, -0.1);
  test_surely_outside<Camera<double>, Splat<double>>(plain);
  test_surely_outside<RayCamera<double>, RaySplat<double>>({plain});
  test_gradients_on_rays();
  test_reach_on_rays();
  return gs::finish_tests("rasterizer projection");
}
