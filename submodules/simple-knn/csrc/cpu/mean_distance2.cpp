// Nearest neighbours by a balanced kd-tree; a grid would be slow on clouds with far outliers. Ranges are halved at the
// median of their widest axis down to a leaf's few points. So the tree's shape depends on n alone and needs no links.
#include <algorithm>
#include <cmath>
#include <vector>

#include "backend.h"
#include "math/nearest.h"

namespace gs {
namespace {

constexpr int64_t kLeaf = 8;

template <class T>
struct Point {
  T x[3];
  int64_t index;
};

template <class T>
struct Split {
  T at;
  int axis;
};

template <class T>
class KdTree {
 public:
  KdTree(std::vector<Point<T>> points, const Executor& executor) : points_(std::move(points)) {
    int64_t size = points_.size();  // of the level's largest node
    for (int64_t nodes = 1; size > kLeaf; nodes *= 2, size = (size + 1) / 2) {
      splits_.resize(2 * nodes - 1);
      for_dynamic(executor, nodes, 1 + 4096 / size, [&](int64_t begin, int64_t end) {
        for (int64_t node = begin; node < end; ++node) split(nodes - 1 + node, range(node, nodes));
      });
    }
    // Nodes of a level have `size` points or one less, so all leaves are on the last level.
    leaves_begin_ = splits_.size();
  }

  const std::vector<Point<T>>& points() const { return points_; }

  Nearest3<T> nearest(int64_t self) const {
    Nearest3<T> found;
    const T outside[3] = {0, 0, 0};
    visit(0, {0, int64_t(points_.size())}, self, outside, found);
    return found;
  }

 private:
  struct Range {
    int64_t begin, end;
    int64_t middle() const { return begin + (end - begin) / 2; }
  };

  // Nodes of a level are numbered from the left. The bits of a node's number, highest first, are the path to it.
  Range range(int64_t node, int64_t nodes) const {
    Range r{0, int64_t(points_.size())};
    for (int64_t bit = nodes / 2; bit > 0; bit /= 2) (node & bit ? r.begin : r.end) = r.middle();
    return r;
  }

  void split(int64_t node, Range r) {
    T low[3], high[3];
    for (int k = 0; k < 3; ++k) low[k] = high[k] = points_[r.begin].x[k];
    for (int64_t i = r.begin + 1; i < r.end; ++i)
      for (int k = 0; k < 3; ++k) {
        low[k] = std::min(low[k], points_[i].x[k]);
        high[k] = std::max(high[k], points_[i].x[k]);
      }
    int axis = 0;
    for (int k = 1; k < 3; ++k)
      if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    const auto first = points_.begin();
    std::nth_element(first + r.begin, first + r.middle(), first + r.end,
                     [axis](const Point<T>& a, const Point<T>& b) { return a.x[axis] < b.x[axis]; });
    splits_[node] = {points_[r.middle()].x[axis], axis};
  }

  // outside: the distance from the point to the node's box, along each axis.
  void visit(int64_t node, Range r, int64_t self, const T outside[3], Nearest3<T>& found) const {
    const T* x = points_[self].x;
    if (node >= leaves_begin_) {
      for (int64_t i = r.begin; i < r.end; ++i) {
        const T* y = points_[i].x;
        if (i != self) found.add(squared_length(x[0] - y[0], x[1] - y[1], x[2] - y[2]));
      }
      return;
    }
    const Split<T> split = splits_[node];
    const T beyond = x[split.axis] - split.at;
    const bool right = beyond >= 0;
    const Range halves[2] = {{r.begin, r.middle()}, {r.middle(), r.end}};
    visit(2 * node + 1 + right, halves[right], self, outside, found);
    T farther[3] = {outside[0], outside[1], outside[2]};
    farther[split.axis] = beyond;
    if (squared_length(farther[0], farther[1], farther[2]) < found.d2)
      visit(2 * node + 2 - right, halves[!right], self, farther, found);
  }

  std::vector<Point<T>> points_;
  std::vector<Split<T>> splits_;  // the tree's inner nodes in heap order
  int64_t leaves_begin_;
};

}  // namespace

template <class T>
void mean_distance2(const T* points, int64_t n, T* out, const Executor& executor) {
  std::vector<Point<T>> finite;
  finite.reserve(n);
  for (int64_t i = 0; i < n; ++i) {
    const T* x = points + 3 * i;
    out[i] = 0;
    if (std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2])) finite.push_back({{x[0], x[1], x[2]}, i});
  }
  const KdTree<T> tree(std::move(finite), executor);
  // In the tree's order, points that are neighbours in memory visit the same nodes.
  for_dynamic(executor, tree.points().size(), 512, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) out[tree.points()[i].index] = tree.nearest(i).mean();
  });
}

template void mean_distance2(const float*, int64_t, float*, const Executor&);
template void mean_distance2(const double*, int64_t, double*, const Executor&);

}  // namespace gs
