// The CUDA kernels on the CPU (submodules/common/emulation), under the sanitizers, against the CPU backend: the same
// bits in any order of the threads.
#include "backend.h"
#include "clouds.h"
#include "cuda/box_tree.h"
#include "emulated_queue.h"
#include "gs/check.h"

namespace {

template <class T>
void check_cloud(const std::vector<T>& points) {
  const int64_t n = points.size() / 3;
  std::vector<T> wanted(n), got(n);
  gs::mean_distance2(points.data(), n, wanted.data(), gs::serial_executor());
  for (const auto order : gs::emulation::kOrders) {
    gs::emulation::order = order;
    gs::emulation::Memory memory;
    std::fill(got.begin(), got.end(), T(-1));
    gs::mean_distance2(points.data(), n, got.data(), memory.queue());
    CHECK(got == wanted);
  }
}

template <class T>
void check_clouds() {
  for (const int n : kSizes) for_clouds<T>(n, check_cloud<T>);
  for_clouds<T>(100, [](std::vector<T> points) {
    points[4] = std::numeric_limits<T>::infinity(), points[16] = std::numeric_limits<T>::quiet_NaN();
    check_cloud(points);
    for (T& x : points) x = std::numeric_limits<T>::max() * std::tanh(x);  // distances overflow
    check_cloud(points);
  });
}

// Nodes and points of a level that is too large to build here.
void check_largest_level() {
  const int64_t n = (int64_t(1) << 31) - 1;
  const int level = gs::leaf_level(n);
  for (const int64_t node : {int64_t(0), int64_t(1), int64_t(12345), (int64_t(1) << level) - 1}) {
    CHECK(gs::node_of(n, level, gs::first_point(n, level, node)) == node);
    CHECK(gs::node_of(n, level, gs::first_point(n, level, node + 1) - 1) == node);
  }
}

}  // namespace

int main() {
  check_clouds<float>(), check_clouds<double>();
  check_largest_level();
  return gs::finish_tests("CUDA nearest neighbours, emulated");
}
