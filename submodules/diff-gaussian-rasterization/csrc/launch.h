#pragma once
// What a backend offers: plain structs of pointers and sizes, and the functions that work on them. N Gaussians, W x H
// image, I instances (splat, tile). All arrays row-major and contiguous unless a stride is given; T is float or double.
#include <cstdint>

#include "gs/cuda_queue.h"
#include "gs/parallel.h"

namespace gs {

struct Image {
  int width, height;
};

template <class T>
struct Scene {
  int64_t count;
  const T* means;                  // (N, 3)
  const T* opacities;              // (N)
  const T* scales;                 // (N, 3), or null with cov3d
  const T* rotations;              // (N, 4) w x y z
  const T* cov3d;                  // (N, 6) xx xy xz yy yz zz, or null
  const T* colors;                 // (N, 3), or null with sh
  const T* sh_dc;                  // (N, 3), row stride below
  const T* sh_rest;                // (N, M, 3)
  int64_t dc_stride, rest_stride;  // values from row to row
  int rest_bands;                  // M
  int sh_degree;
  bool raw;  // opacities are logits, scales logs, rotations of any length
  bool antialiasing;
  T scale_modifier;
  const T* view;        // 4x4, transposed
  const T* projection;  // 4x4, full, transposed
  const T* center;      // 3
  double tan_x, tan_y;
  Image image;
};

// What a GPU's binning reads of a splat, in one sector of memory: it visits them in the order of their depth.
struct alignas(16) TileRecord {
  uint64_t reached;         // a bit for each tile of a rectangle of at most 64, in its order; of a larger one, how many
  uint16_t x0, y0, x1, y1;  // empty where the splat reaches none
};

template <class T>
struct Projected {
  T* splats;       // (N, 10), Splat in math/splat.h; undefined where tile_counts is 0
  T* depths;       // (N) infinite where tile_counts is 0: binning takes those last
  int32_t* rects;  // (N, 4) tiles x0 y0 x1 y1, undefined where tile_counts is 0; a GPU with records may do without
  int32_t* tile_counts;  // (N)
  int32_t* radii;        // (N)
  TileRecord* records;   // (N), or null
};

// Gradients of Scene's inputs; null where not wanted. Every row is written.
template <class T>
struct SceneGradient {
  T* means;
  T* means2d;  // (N, 3): per NDC unit, 0
  T* opacities;
  T* scales;
  T* rotations;
  T* cov3d;
  T* colors;
  T* sh_dc;
  T* sh_rest;
};

// The slots (math/slots.h) of a splat: a tile of its rectangle each, row by row; none where it is culled.
struct alignas(16) SplatSlots {
  int64_t first;          // the slots of all splats before
  int32_t skipped, wide;  // tiles in front of the rectangle, were all rows as wide as it; its width
};

struct Binned {
  int32_t* instances;  // (I) splat, by tile and inside by depth, ties by index
  int64_t* ranges;     // (tiles + 1) into instances
};

// Where binning gets the memory of its lists once it has counted; it may throw.
struct BinMemory {
  Binned (*take)(void* context, int64_t instances, int64_t slots);
  void* context;
  SplatSlots* slots;  // (N + 1), filled by binning; or null: none
};

template <class T>
struct BlendInput {
  const T* splats;
  const int32_t* instances;
  const int64_t* ranges;
  const T* background;  // 3
  Image image;
};

template <class T>
struct Blended {
  T* color;          // (3, H, W)
  T* transmittance;  // (H, W)
  T* inverse_depth;  // (H, W), or null
  int32_t* last;     // (H, W) 1 + position in the tile's list of the last splat blended, or null
};

template <class T>
struct BlendGradient {
  int64_t count, instance_count, slot_count;
  const SplatSlots* slots;
  const T* transmittance;
  const int32_t* last;
  const T* color;                   // dLoss/dcolor
  const T* inverse_depth;           // or null
  const T* transmittance_gradient;  // or null
  T* moments;                       // out: (N, 10), Moments in math/footprint.h, then colour and inverse depth
};

// A tensor that takes a step of Adam in place, with the `columns` leading values of each row.
template <class T>
struct AdamInput {
  T* value;
  const T* gradient;
  T* mean;
  T* square;
  int64_t rows, row, columns;
  double lr, beta1, beta2, eps, step;
};

// Ends the steps of a training for good at the first one that is not finite. With `stopped` null it never does.
template <class T>
struct StepGuard {
  const T* loss;     // scalar; if it is not finite, there is no step
  int64_t* stopped;  // the first iteration whose loss or step was not finite, 0 while there is none; after it, no step
  int64_t iteration;
};

// Adds a view to the statistics of density control.
struct ObserveInput {
  int64_t count;
  float *max_radii, *gradient_sums, *views;  // (N), updated: Observed in math/observe.h
  const int32_t* radii;                      // (N) of this view
  const float* gradients;  // (N, 3) of the means on the screen: x and y, and a third that counts nothing
};

// Every backend's functions. `Where` says how they run: an Executor on the CPU, a Queue on a GPU.
#define GS_BACKEND(Where)                                                                       \
  template <class T>                                                                            \
  void project(const Where&, const Scene<T>&, const Projected<T>&);                             \
  template <class T>                                                                            \
  void project_vjp(const Where&, const Scene<T>&, const int32_t* tile_counts, const T* moments, \
                   const SceneGradient<T>&);                                                    \
  template <class T>                                                                            \
  void mark_visible(const Where&, int64_t count, const T* means, const T* view, bool* visible); \
  template <class T>                                                                            \
  void bin(const Where&, int64_t count, const Projected<T>&, Image, const BinMemory&);          \
  template <class T>                                                                            \
  void blend(const Where&, const BlendInput<T>&, const Blended<T>&);                            \
  template <class T>                                                                            \
  void blend_vjp(const Where&, const BlendInput<T>&, const BlendGradient<T>&);                  \
  template <class T>                                                                            \
  void mark_decisive(const Where&, const BlendInput<T>&, const int32_t* last, bool* decisive);  \
  template <class T>                                                                            \
  void adam(const Where&, const AdamInput<T>* tensors, int64_t count, const StepGuard<T>&);     \
  /* Adam without bias correction on the rows that are visible, (rows); `step` is not read. */  \
  template <class T>                                                                            \
  void sparse_adam(const Where&, const AdamInput<T>&, const bool* visible, const StepGuard<T>&);

void observe(const Executor&, const ObserveInput&);  // compiled once: see gs/rounded.h

namespace baseline {
GS_BACKEND(Executor)
}
#ifdef GS_X86
namespace avx2 {
GS_BACKEND(Executor)
}
namespace avx512 {
GS_BACKEND(Executor)
}
#endif
namespace cuda {
GS_BACKEND(Queue)
void observe(const Queue&, const ObserveInput&);
// Where the gradients go: asked for when the GPU has work to do meanwhile.
struct GradientMemory {
  SceneGradient<float> (*take)(void* context);
  void* context;
};
// blend_vjp and project_vjp in one, without the moments in between (BlendGradient::moments is not written).
void rasterize_vjp(const Queue&, const Scene<float>&, const BlendInput<float>&, const BlendGradient<float>&,
                   const GradientMemory&);
}  // namespace cuda

}  // namespace gs
