#pragma once
// The structs of pointers and sizes of gsplat's function.
#include "../data.h"

namespace gs {

// Splats to be described (math/describe.h), rows of `row` values: `count` of them, by `rows`, or the first ones if it
// is null, here and below.
template <class T>
struct DescribeInput {
  int64_t count;
  const int64_t* rows;
  int row;
  const T *splats, *depths;  // with Scene::keeps_shapes
  const int32_t* tile_counts;
  Image image;
};
template <class T>
struct Descriptions {
  int32_t* radii;  // (N, 2) px
  T* centers;      // (N, 2) px, pixel centres at halves
  T* depths;       // (N)
  T* conics;       // (N, 3) xx xy yy of the inverse covariance
  T* opacities;    // (N)
  int32_t* tiles;  // (N), or null
};

// Moments of the splats' exponents (BlendGradient), and the gradients that they are.
template <class T>
struct DescribedInput {
  int64_t count;
  const int64_t* rows;
  int row;  // values of a splat's row, and of its moments'
  const T *splats, *moments;
  const int32_t* tile_counts;
};
template <class T>
struct DescribedGradient {
  T *centers, *conics, *opacities;  // (N, 2), (N, 3), (N)
};

// A pinhole's view and full projection, both transposed, and its centre: Scene::view and what follows.
template <class T>
struct PinholeMatrices {
  T *view, *full, *center;
};

}  // namespace gs
