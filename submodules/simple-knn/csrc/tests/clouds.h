#pragma once
// Clouds of points that are hard for a tree, for tests of both backends.
#include <cmath>
#include <limits>
#include <random>
#include <vector>

// Sizes around those where leaves and levels change.
constexpr int kSizes[] = {0, 1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 18, 33, 64, 65, 500};

// Calls check(points) for clouds of n points.
template <class T, class Check>
void for_clouds(int n, const Check& check) {
  std::mt19937 random(1);
  std::normal_distribution<T> normal;
  std::vector<T> points(3 * n);
  for (T& x : points) x = normal(random);
  check(points);
  for (T& x : points) x = std::round(x);  // many duplicates and ties
  check(points);
  for (int i = 0; i < n; ++i) points[3 * i + 1] = points[3 * i + 2] = 0;  // collinear
  check(points);
  check(std::vector<T>(3 * n, T(0.1)));
  for (T& x : points) x = std::exp(8 * normal(random));  // far outliers
  check(points);
}
