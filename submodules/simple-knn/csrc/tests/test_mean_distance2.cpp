// The kd-tree against all pairs.
#include <algorithm>

#include "backend.h"
#include "clouds.h"
#include "gs/check.h"
#include "gs/check_threads.h"

namespace {

// The definition, in the arithmetic of T.
template <class T>
T all_pairs(const std::vector<T>& points, size_t i) {
  std::vector<T> distances;
  for (size_t j = 0; j < points.size() / 3; ++j) {
    T sum = 0;
    for (int k = 0; k < 3; ++k)
      sum += (points[3 * i + k] - points[3 * j + k]) * (points[3 * i + k] - points[3 * j + k]);
    if (j != i) distances.push_back(sum);
  }
  std::sort(distances.begin(), distances.end());
  const size_t count = std::min<size_t>(3, distances.size());
  T sum = 0;
  for (size_t k = 0; k < count; ++k) sum += distances[k];
  return count ? sum / T(count) : 0;
}

template <class T>
void check_cloud(const std::vector<T>& points) {
  const int64_t n = points.size() / 3;
  std::vector<T> serial(n), threaded(n);
  gs::mean_distance2(points.data(), n, serial.data(), gs::serial_executor());
  gs::mean_distance2(points.data(), n, threaded.data(), gs::three_threads());
  CHECK(serial == threaded);
  for (int64_t i = 0; i < n; ++i) {
    const double wanted = all_pairs(points, i);
    // Both round some eight operations.
    CHECK_NEAR(serial[i], wanted, 8 * wanted * std::numeric_limits<T>::epsilon());
  }
}

}  // namespace

int main() {
  for (const int n : kSizes) for_clouds<float>(n, check_cloud<float>), for_clouds<double>(n, check_cloud<double>);
  return gs::finish_tests("mean_distance2");
}
