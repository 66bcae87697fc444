// The CUDA backend's tree, built and searched on the host, against the CPU backend.
#include <algorithm>
#include <cmath>
#include <numeric>
#include <random>
#include <vector>

#include "backend.h"
#include "cuda/box_tree.h"
#include "gs/check.h"

namespace {

using namespace gs;

template <class T>
Extent extent_of(const std::vector<T>& points, const std::vector<int32_t>& order, int64_t begin, int64_t end) {
  Extent e{{~0u, ~0u, ~0u}, {0, 0, 0}};
  for (int64_t i = begin; i < end; ++i)
    for (int k = 0; k < 3; ++k) {
      e.low[k] = std::min(e.low[k], sortable(float(points[3 * order[i] + k])));
      e.high[k] = std::max(e.high[k], sortable(float(points[3 * order[i] + k])));
    }
  return e;
}

// Builds and searches the tree as mean_distance2.cu does, level by level.
template <class T>
std::vector<T> search(const std::vector<T>& points) {
  const int64_t n = points.size() / 3;
  const int last = leaf_level(n);
  std::vector<int32_t> order(n);
  std::iota(order.begin(), order.end(), 0);
  for (int level = 0; level < last; ++level) {
    std::vector<std::pair<uint64_t, int32_t>> keyed(n);
    for (int64_t node = 0; node < int64_t(1) << level; ++node) {
      const int64_t begin = first_point(n, level, node), end = first_point(n, level, node + 1);
      const Extent extent = extent_of(points, order, begin, end);
      for (int64_t i = begin; i < end; ++i) {
        CHECK(node_of(n, level, i) == node);
        keyed[i] = {split_key(node, extent, &points[3 * order[i]]), order[i]};
      }
    }
    std::stable_sort(keyed.begin(), keyed.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
    for (int64_t i = 0; i < n; ++i) order[i] = keyed[i].second;
  }

  std::vector<TreePoint<T>> sorted;
  for (const int32_t i : order) sorted.push_back({{points[3 * i], points[3 * i + 1], points[3 * i + 2]}, i});
  std::vector<Box<T>> boxes(size_t(2) << last);
  const int64_t leaves = int64_t(1) << last;
  for (int64_t leaf = 0; leaf < leaves; ++leaf) {
    const int64_t begin = first_point(n, last, leaf), end = first_point(n, last, leaf + 1);
    CHECK(begin < end && end - begin <= kLeaf);
    boxes[leaves + leaf] = box_of_leaf(sorted.data(), begin, end);
  }
  for (int64_t node = leaves - 1; node > 0; --node) {
    boxes[node] = boxes[2 * node];
    boxes[node].add(boxes[2 * node + 1]);
  }
  const BoxTree<T> tree{sorted.data(), boxes.data(), n, last};
  std::vector<T> out(n);
  for (int64_t i = 0; i < n; ++i) out[sorted[i].index] = tree.nearest(i).mean();
  return out;
}

template <class T>
void check_cloud(const std::vector<T>& points) {
  const int64_t n = points.size() / 3;
  std::vector<T> wanted(n);
  mean_distance2_cpu(points.data(), n, wanted.data(), serial_executor());
  const std::vector<T> got = search(points);
  // The same sums of the same pairs, but a compiler may fuse a product with a sum in one of them only.
  for (int64_t i = 0; i < n; ++i)
    CHECK_NEAR(got[i], wanted[i], 4 * std::numeric_limits<T>::epsilon() * double(wanted[i]));
}

template <class T>
void check_clouds() {
  std::mt19937 random(1);
  std::normal_distribution<T> normal;
  // Sizes around those where leaves and levels change.
  for (int n : {1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 18, 31, 32, 33, 65, 500, 1023}) {
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
    for (T& x : points) x = std::numeric_limits<T>::max() * std::tanh(normal(random));  // distances overflow
    check_cloud(points);
  }
}

void check_keys() {
  const float values[] = {-INFINITY, -1e30f, -2, -1, -1e-40f, 0, 1e-40f, 1, 1.0000001f, 2, 1e30f, INFINITY};
  for (const float a : values) {
    CHECK(from_sortable(sortable(a)) == a);
    for (const float b : values) CHECK((a < b) == (sortable(a) < sortable(b)));
  }
  // Nodes and points of a level too large to build.
  const int64_t n = (int64_t(1) << 31) - 1;
  const int level = leaf_level(n);
  for (const int64_t node : {int64_t(0), int64_t(1), int64_t(12345), (int64_t(1) << level) - 1}) {
    CHECK(node_of(n, level, first_point(n, level, node)) == node);
    CHECK(node_of(n, level, first_point(n, level, node + 1) - 1) == node);
  }
}

}  // namespace

int main() {
  check_keys();
  check_clouds<float>();
  check_clouds<double>();
  return finish_tests("simple-knn/test_box_tree");
}
