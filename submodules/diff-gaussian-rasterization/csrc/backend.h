#pragma once
// The functions that every backend offers, and the callbacks through which they get memory.
#include "data.h"
#include "gs/cuda_queue.h"
#include "gs/isa.h"
#include "gs/parallel.h"

namespace gs {

// Allocates binning's lists once it has counted them; may throw.
struct BinMemory {
  Binned (*take)(void* context, int64_t instances, int64_t slots);
  void* context;
  SplatSlots* slots;             // (N + 1), filled by binning, or null if not wanted
  const Ahead* ahead = nullptr;  // on a GPU: take room for lists, and do not wait for their lengths
};

// Allocates gradient rows once their number is known; may throw.
template <class T>
struct RowMemory {
  T* (*take)(void* context, int64_t rows);  // as in SplatRows
  void* context;
  int32_t* counts;  // (N) rows of each splat, filled
  bool absolute;    // whether rows have what lengths of absolute gradients need
};

// Every backend's functions. `Where` says how they run: an Executor on the CPU, a Queue on a GPU.
#define GS_BACKEND(Where)                                                                            \
  template <class T>                                                                                 \
  void project(const Where&, const Scene<T>&, const Projected<T>&);                                  \
  template <class T>                                                                                 \
  void project_vjp(const Where&, const Scene<T>&, const int32_t* tile_counts, const T* moments,      \
                   const SceneGradient<T>&);                                                         \
  template <class T>                                                                                 \
  void bin(const Where&, int64_t count, const Projected<T>&, Image, const BinMemory&);               \
  template <class T>                                                                                 \
  void blend(const Where&, const BlendInput<T>&, const Blended<T>&);                                 \
  template <class T>                                                                                 \
  void blend_vjp(const Where&, const BlendInput<T>&, const BlendGradient<T>&);                       \
  /* The rows of the processed instances, which blend_vjp sums, of colours. No gradient's output is  \
     written. */                                                                                     \
  template <class T>                                                                                 \
  void blend_rows(const Where&, const BlendInput<T>&, const BlendGradient<T>&, const RowMemory<T>&); \
  template <class T>                                                                                 \
  void mark_decisive(const Where&, const BlendInput<T>&, const int32_t* last, bool* decisive);       \
  template <class T>                                                                                 \
  void adam(const Where&, const AdamInput<T>* tensors, int64_t count, const StepGuard<T>&);          \
  /* Adam on the visible rows, (rows); where `step` is 0, without bias correction. */                \
  template <class T>                                                                                 \
  void sparse_adam(const Where&, const AdamInput<T>&, const bool* visible, const StepGuard<T>&);     \
  template <class T>                                                                                 \
  void penalise(const Where&, const PenaltyInput<T>&);                                               \
  /* The table of a lens with rays (math/lens_pixels.h). */                                          \
  template <class T>                                                                                 \
  void lens_table(const Where&, const Lens<double>&, Image, T* out);                                 \
  /* The values of the scene change. */                                                              \
  template <class T>                                                                                 \
  void wake(const Where&, const Scene<T>&, const SleepInput<T>&);

// Compiled once: see gs/rounded.h.
void observe(const Executor&, const ObserveInput&);
void displace(const Executor&, const Displacement&);
void elementary(const Executor&, const Elementary&);
void random_words(const Executor&, const RandomInput&);
// How many records each block of splats has: (bands + 1, record_blocks), last those of all bands.
void count_records(const Executor&, const RecordInput&, int32_t* counts);
template <class T>
void list_records(const Executor&, const RecordInput&, const RecordLists<T>&);
template <class T>
void sum_runs(const Executor&, const SumInput<T>&);
// What else the CPU offers. sum_rows: the rest of blend_vjp after blend_rows. project_vjp_step: project_vjp, and every
// Gaussian's step as soon as its gradients are known. camera_vjp: what each block of kSleepBlock
// Gaussians adds to the gradients of the camera's numbers, (blocks, numbers) (math/camera_gradient.h).
#define GS_CPU_BACKEND                                                                                  \
  GS_BACKEND(Executor)                                                                                  \
  template <class T>                                                                                    \
  void sum_rows(const Executor&, const SplatRows<T>&, const RowSums<T>&);                               \
  template <class T>                                                                                    \
  void project_vjp_step(const Executor&, const Scene<T>&, const int32_t* tile_counts, const T* moments, \
                        const GaussianStep<T>&);                                                        \
  template <class T>                                                                                    \
  void camera_vjp(const Executor&, const Scene<T>&, const int32_t* tile_counts, const T* moments, double* sums);

#define GS_DECLARE(isa) \
  namespace isa {       \
  GS_CPU_BACKEND        \
  }
GS_EACH_ISA(GS_DECLARE)
#undef GS_DECLARE
namespace cuda {
GS_BACKEND(Queue)
void observe(const Queue&, const ObserveInput&);
void displace(const Queue&, const Displacement&);
void elementary(const Queue&, const Elementary&);
void random_words(const Queue&, const RandomInput&);
void count_records(const Queue&, const RecordInput&, int32_t* counts);
void list_records(const Queue&, const RecordInput&, const RecordLists<float>&);
void sum_runs(const Queue&, const SumInput<float>&);
// Allocates the gradients; called while the GPU is busy, so that the host's work costs no time.
struct GradientMemory {
  SceneGradient<float> (*take)(void* context);
  void* context;
};
// blend_vjp and project_vjp in one, without the moments in between (BlendGradient::moments is not written).
void rasterize_vjp(const Queue&, const Scene<float>&, const BlendInput<float>&, const BlendGradient<float>&,
                   const GradientMemory&);
// The same, and every Gaussian's step as soon as its gradients are known. No gradient is written.
void rasterize_vjp_step(const Queue&, const Scene<float>&, const BlendInput<float>&, const BlendGradient<float>&,
                        const GaussianStep<float>&);
// Both from the rows of blend_rows. RowSums::moments is not written.
void rows_vjp(const Queue&, const Scene<float>&, const SplatRows<float>&, const RowSums<float>&, const GradientMemory&);
void rows_vjp_step(const Queue&, const Scene<float>&, const SplatRows<float>&, const RowSums<float>&,
                   const GaussianStep<float>&);
// From the same rows, which it only reads, to what blocks add to the gradients of the camera's numbers, as on the CPU;
// and the sums over blocks.
void camera_vjp(const Queue&, const Scene<float>&, const SplatRows<float>&, double* sums);
void camera_vjp(const Queue&, const Scene<float>&, const int32_t* tile_counts, const float* moments, double* sums);
void sum_blocks(const Queue&, int64_t blocks, int64_t numbers, const double* sums, double* out);
}  // namespace cuda
using cuda::observe, cuda::displace, cuda::elementary, cuda::random_words, cuda::count_records;

}  // namespace gs
