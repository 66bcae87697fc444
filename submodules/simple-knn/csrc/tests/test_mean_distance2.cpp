// The kd-tree against all pairs, on clouds that are hard for a tree.
#include <algorithm>
#include <random>
#include <vector>

#include "backend.h"
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
  gs::mean_distance2_cpu(points.data(), n, serial.data(), gs::serial_executor());
  gs::mean_distance2_cpu(points.data(), n, threaded.data(), gs::three_threads());
  CHECK(serial == threaded);
  for (int64_t i = 0; i < n; ++i) {
    const double wanted = all_pairs(points, i);
    // Both round some eight operations.
    CHECK_NEAR(serial[i], wanted, 8 * wanted * std::numeric_limits<T>::epsilon());
  }
}

template <class T>
void check_clouds() {
  std::mt19937 random(1);
  std::normal_distribution<T> normal;
  // Sizes around those where leaves and levels change.
  for (int n : {0, 1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 18, 33, 64, 65, 500}) {
    std::vector<T> points(3 * n);
    for (T& x : points) x = normal(random);
    check_cloud(points);
    for (T& x : points) x = std::round(x);  // many duplicates and ties
    check_cloud(points);
    for (int i = 0; i < n; ++i) points[3 * i + 1] = points[3 * i + 2] = 0;  // collinear
    check_cloud(points);
    check_cloud(std::vector<T>(3 * n, T(0.1)));
    for (T& x : points) x = std::exp(8 * normal(random));  // far outliers
    check_cloud(points);
  }
}

template <class T>
void check_extremes() {
  const T infinity = std::numeric_limits<T>::infinity(), nan = std::numeric_limits<T>::quiet_NaN();
  const T largest = std::numeric_limits<T>::max();
  const std::vector<T> points = {0, 0, 0, nan, 0, 0, 0, 1, 0, 0, 0, -infinity, 0, 0, 3};
  std::vector<T> out(5);
  gs::mean_distance2_cpu(points.data(), 5, out.data(), gs::serial_executor());
  CHECK_NEAR(out[0], 5, 0);
  CHECK(out[1] == 0 && out[3] == 0);
  CHECK_NEAR(out[2], 5.5, 0);
  CHECK_NEAR(out[4], 9.5, 0);

  std::vector<T> far(3 * 20);  // every squared distance overflows
  for (int i = 0; i < 20; ++i) far[3 * i] = (i - 10) * (largest / 16);
  out.assign(20, 0);
  gs::mean_distance2_cpu(far.data(), 20, out.data(), gs::serial_executor());
  for (T value : out) CHECK(value == largest);
}

}  // namespace

int main() {
  check_clouds<float>();
  check_clouds<double>();
  check_extremes<float>();
  check_extremes<double>();
  return gs::finish_tests("mean_distance2");
}
