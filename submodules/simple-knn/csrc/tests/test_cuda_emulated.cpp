// The CUDA kernels on the CPU (submodules/common/emulation), under the sanitizers, against the CPU backend: the same
// bits in any order of the threads.
#include <limits>
#include <random>
#include <vector>

#include "backend.h"
#include "emulated_queue.h"
#include "gs/check.h"

namespace {

template <class T>
void check_cloud(const std::vector<T>& points) {
  const int64_t n = points.size() / 3;
  std::vector<T> wanted(n), got(n);
  gs::mean_distance2_cpu(points.data(), n, wanted.data(), gs::serial_executor());
  for (const auto order : gs::emulation::kOrders) {
    gs::emulation::order = order;
    gs::emulation::Memory memory;
    std::fill(got.begin(), got.end(), T(-1));
    gs::mean_distance2_cuda(points.data(), n, got.data(), memory.queue());
    CHECK(got == wanted);
  }
}

template <class T>
void check_clouds() {
  std::mt19937 random(3);
  std::normal_distribution<double> normal;
  for (int64_t n : {0, 1, 2, 3, 8, 9, 100, 700}) {
    std::vector<T> points(3 * n);
    for (T& x : points) x = T(normal(random));
    check_cloud(points);
    for (T& x : points) x = T(int(x));  // many duplicates
    check_cloud(points);
    if (n < 9) continue;
    points[4] = std::numeric_limits<T>::infinity();
    points[16] = std::numeric_limits<T>::quiet_NaN();
    check_cloud(points);
  }
}

}  // namespace

int main() {
  check_clouds<float>(), check_clouds<double>();
  return gs::finish_tests("CUDA nearest neighbours, emulated");
}
