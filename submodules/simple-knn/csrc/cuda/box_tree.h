#pragma once
// A balanced tree of boxes over sorted points, and the search in it. This includes no CUDA runtime, so that csrc/tests
// runs the same lines on the host.
//
// Nodes are numbered from 1 as in a heap: level l has the nodes 2^l to 2^(l+1) - 1, the children of v are 2 v and
// 2 v + 1, and all leaves are on the last level. Node i of a level's 2^l has the points from floor(n i / 2^l) up to,
// but not including, floor(n (i + 1) / 2^l), so the tree needs no links.
#include <cstdint>
#include <cstring>

#include "math/nearest.h"

namespace gs {

constexpr int64_t kLeaf = 8;  // points of a leaf, at most

GS_HD int leaf_level(int64_t n) {
  int level = 0;
  while (((n - 1) >> level) + 1 > kLeaf) ++level;
  return level;
}

GS_HD int64_t first_point(int64_t n, int level, int64_t i) { return (n * i) >> level; }

// The node of `level` that holds point `at`: the largest i with first_point(i) <= at.
GS_HD int64_t node_of(int64_t n, int level, int64_t at) { return (((at + 1) << level) - 1) / n; }

// A monotone map from float to integers. -0 and 0 get different integers, which does no harm here.
GS_HD uint32_t sortable(float x) {
  uint32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}
GS_HD float from_sortable(uint32_t bits) {
  bits = bits & 0x80000000u ? bits & 0x7fffffffu : ~bits;
  float x;
  std::memcpy(&x, &bits, sizeof x);
  return x;
}

// The smallest and largest coordinates of a node's points, as sortable integers of the nearest float. They are accurate
// enough to choose an axis, and their minima and maxima do not depend on the order of the threads.
struct Extent {
  uint32_t low[3], high[3];
};

GS_HD int widest_axis(const Extent& e) {
  int axis = 0;
  float widest = -1;  // doubles beyond float may give NaN, which is never the widest
  for (int k = 0; k < 3; ++k) {
    const float width = from_sortable(e.high[k]) - from_sortable(e.low[k]);
    if (!(width > widest)) continue;
    widest = width;
    axis = k;
  }
  return axis;
}

// The sort key: sorted by it, the points of each node of a level fall into its children at the median of the widest
// axis.
template <class T>
GS_HD uint64_t split_key(int64_t node, const Extent& extent, const T* point) {
  return uint64_t(node) << 32 | sortable(float(point[widest_axis(extent)]));
}

template <class T>
struct alignas(4 * sizeof(T)) TreePoint {
  T x[3];
  int32_t index;
};

template <class T>
struct alignas(2 * sizeof(T)) Box {
  T low[3], high[3];

  GS_HD void add(const Box& other) {
    for (int k = 0; k < 3; ++k) {
      if (other.low[k] < low[k]) low[k] = other.low[k];
      if (other.high[k] > high[k]) high[k] = other.high[k];
    }
  }

  GS_HD T distance2(const T* x) const {
    T outside[3];
    for (int k = 0; k < 3; ++k) outside[k] = x[k] < low[k] ? low[k] - x[k] : x[k] > high[k] ? x[k] - high[k] : T(0);
    return squared_length(outside[0], outside[1], outside[2]);
  }
};

template <class T>
GS_HD Box<T> box_of_leaf(const TreePoint<T>* points, int64_t begin, int64_t end) {
  Box<T> box;
  for (int k = 0; k < 3; ++k) box.low[k] = box.high[k] = points[begin].x[k];
  for (int64_t i = begin + 1; i < end; ++i) {
    Box<T> one;
    for (int k = 0; k < 3; ++k) one.low[k] = one.high[k] = points[i].x[k];
    box.add(one);
  }
  return box;
}

template <class T>
struct BoxTree {
  const TreePoint<T>* points;
  const Box<T>* boxes;  // by node
  int64_t n;
  int level;  // of the leaves

  GS_HD void scan(int64_t node, int64_t self, const T* x, Nearest3<T>& found) const {
    const int64_t leaf = node - (int64_t(1) << level);
    const int64_t end = first_point(n, level, leaf + 1);
    for (int64_t i = first_point(n, level, leaf); i < end; ++i) {
      const TreePoint<T> y = points[i];
      if (i != self) found.add(squared_length(x[0] - y.x[0], x[1] - y.x[1], x[2] - y.x[2]));
    }
  }

  // Searches from the point's own leaf upwards, which finds the nearest first and needs no stack. Bit l of `pending` is
  // set while the sibling of the node l levels above still has to be visited.
  GS_HD Nearest3<T> nearest(int64_t self) const {
    const TreePoint<T> point = points[self];
    Nearest3<T> found;
    const int64_t leaves = int64_t(1) << level;
    int64_t node = leaves + node_of(n, level, self);
    uint32_t pending = uint32_t(leaves - 1);
    scan(node, self, point.x, found);
    while (pending != 0) {
      for (; (pending & 1) == 0; pending >>= 1) node >>= 1;
      node ^= 1;
      pending ^= 1;
      if (!(boxes[node].distance2(point.x) < found.d2)) continue;
      while (node < leaves) {
        const bool right = boxes[2 * node + 1].distance2(point.x) < boxes[2 * node].distance2(point.x);
        node = 2 * node + right;
        pending = pending << 1 | 1;
      }
      scan(node, self, point.x, found);
    }
    return found;
  }
};

}  // namespace gs
