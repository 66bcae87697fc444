#pragma once
// Where the gradients of a scene come from: the lists that a forward has made, or gradient rows. Both classes have the
// same functions, so that one op's code serves either.
#include "backward.h"
#include "scene.h"

#define LISTS_SCHEMA BACKWARD_SCHEMA ", Tensor tile_counts, Tensor layers"
#define LISTS_PARAMETERS BACKWARD_PARAMETERS, const Tensor &tile_counts, const Tensor &layers
#define LISTS_ARGUMENTS BACKWARD_ARGUMENTS, tile_counts, layers

#define ROWS_SCHEMA "Tensor splats, Tensor tile_counts, Tensor rows, Tensor counts"
#define ROWS_PARAMETERS const Tensor &splats, const Tensor &tile_counts, const Tensor &rows, const Tensor &counts
#define ROWS_ARGUMENTS splats, tile_counts, rows, counts

namespace gs::ops {

// Values of a gradient row, with those of absolute gradients or without.
int64_t row_values(bool absolute);

class Lists {
 public:
  explicit Lists(const SceneTensors& scene, LISTS_PARAMETERS);

  const Tensor& tile_counts() const { return tile_counts_; }

  // Lengths of absolute gradients are written to `lengths`, if it is defined, here and below.
  Tensor moments(const Tensor& lengths) const { return blend_vjp(blend_, lengths); }
#ifdef GS_CUDA
  void vjp(const gs::Queue&, const gs::Scene<float>&, const Tensor& lengths, const gs::cuda::GradientMemory&) const;
  void step(const gs::Queue&, const gs::Scene<float>&, const Tensor& lengths, const gs::GaussianStep<float>&) const;
#endif

 private:
  Tensor tile_counts_;
  BlendBackward blend_;
};

class Rows {
 public:
  // absolute: whether rows have the values of absolute gradients. lengths: whether these will be asked for.
  explicit Rows(const SceneTensors& scene, ROWS_PARAMETERS, bool absolute, bool lengths);

  const Tensor& tile_counts() const { return tile_counts_; }

  Tensor moments(const Tensor& lengths) const;
#ifdef GS_CUDA
  void vjp(const gs::Queue&, const gs::Scene<float>&, const Tensor& lengths, const gs::cuda::GradientMemory&) const;
  void step(const gs::Queue&, const gs::Scene<float>&, const Tensor& lengths, const gs::GaussianStep<float>&) const;
#endif

 private:
  void check_sum() const;

  template <class T>
  gs::SplatRows<T> input() const {
    return {counts_.size(0), read<int32_t>(tile_counts_), read<int32_t>(counts_), read<T>(rows_), rows_.size(0)};
  }
  template <class T>
  gs::RowSums<T> sums(T* moments, const Tensor& lengths) const {
    return {read<T>(splats_), image_, moments, lengths.defined() ? write<T>(lengths) : nullptr};
  }

  gs::Image image_;
  Tensor splats_, tile_counts_, rows_, counts_;
};

}  // namespace gs::ops
