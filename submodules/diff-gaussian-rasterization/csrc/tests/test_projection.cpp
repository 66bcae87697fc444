// The early test for Gaussians outside of the image, against the whole projection.
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

}  // namespace

int main() {
  const Camera<double> plain = camera(0.05, -0.1);
  test_surely_outside<Camera<double>, Splat<double>>(plain);
  test_surely_outside<RayCamera<double>, RaySplat<double>>({plain});
  return gs::finish_tests("rasterizer projection");
}
