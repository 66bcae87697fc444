#pragma once
// The plain structs of pointers and sizes that math and every backend share. N Gaussians, W x H image, I instances (a
// splat in a tile). All arrays are row-major and contiguous unless a stride is given; T is float or double.
#include <cstdint>
#include <type_traits>

#include "gs/hd.h"

namespace gs {

struct Image {
  int width, height;
};

// How a lens makes two numbers of a direction, before it distorts them. kPinhole: no lens.
enum class Chart : int { kPinhole, kPerspective, kEquidistant, kEquirectangular };

// A lens (math/lens.h) in COLMAP's conventions, but with pixel centres at integers.
template <class T>
struct Lens {
  Chart chart;
  // limit: of the sum of squares of the chart's numbers: nothing beyond is shown. reach: how many times as far as a
  // pinhole of its focal lengths it sees, at least 1.
  T limit, reach;
  // For blocks that sleep. field: of the chart's numbers, beyond which all is at least `beyond` px off the image.
  // steep: px by which a point moves at most, a unit by which the chart's numbers move within the field, or a direction
  // turns.
  T field, steep, beyond;
  T slope;  // px by which a point moves at most, a unit by which the chart's numbers move within the field
  T focal_x, focal_y, center_x, center_y;  // px
  T radial[4], divisor[3], tangential[2], prism[2];
};
constexpr int kLensNumbers = 22;

// What is added to both variances on the image, so that a splat covers at least a pixel.
template <class T>
struct Dilation {
  T area;       // px^2, at most 1
  T exponents;  // area over kHalfLog2e
  T floor;      // of det / det dilated, whose root is the antialiasing factor
};
constexpr double kUsualNear = 0.2, kUsualDilation = 0.3, kUsualFloor = 2.5e-5;  // the factor is at least 0.005
template <class T>
constexpr Dilation<T> dilation_of(double area, double floor = kUsualFloor) {
  return {T(area), T(area / (0.5 / 0.693147180559945309417)), T(floor)};
}

// How pixels see Gaussians: by EWA, or on their rays (math/ray.h), those of a pinhole or of a lens (math/lens_rays.h).
enum Rays : int { kNoRays, kPinholeRays, kLensRays };
// Returns run(rays) with a constant.
template <class Run>
auto by_rays(Rays rays, const Run& run) {
  return rays == kLensRays ? run(std::integral_constant<int, kLensRays>())
         : rays            ? run(std::integral_constant<int, kPinholeRays>())
                           : run(std::integral_constant<int, kNoRays>());
}

// The Gaussians and the camera. The tensors come in the order of Input in torch/scene.h.
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
  bool raw;  // opacities are logits, scales are logarithms, rotations have any length
  bool antialiasing;
  T scale_modifier;
  const T* view;        // 4x4, transposed
  const T* projection;  // 4x4, full, transposed
  const T* center;      // 3
  double tan_x, tan_y;
  Image image;
  const uint8_t* awake = nullptr;   // (sleep_blocks(N)) 0: no Gaussian of the block reaches the image; null: unknown
  const int32_t* blocks = nullptr;  // (listed) on a GPU: the blocks that are awake, ascending, then -1; or null
  int64_t listed = 0;
  Lens<T> lens = {};
  bool on_rays = false;  // in place of EWA
  Dilation<T> dilation = dilation_of<T>(kUsualDilation);
  T near = T(kUsualNear);     // culled at or below this depth in the view
  bool any_rotation = false;  // whether rotations have any length, as raw ones have
  bool keeps_shapes = false;  // whether splats without tiles have all but their colour (Projected::splats)

  GS_HD Rays rays() const { return !on_rays ? kNoRays : lens.chart == Chart::kPinhole ? kPinholeRays : kLensRays; }
  // Rows of what is made of the Gaussians: a row for each, or for those of the listed blocks alone.
  GS_HD int64_t rows() const;
};

// Gaussians sleep and wake in blocks of so many.
constexpr int64_t kSleepBlock = 128;
GS_HD constexpr int64_t sleep_blocks(int64_t count) { return (count + kSleepBlock - 1) / kSleepBlock; }
template <class T>
GS_HD int64_t Scene<T>::rows() const {
  return blocks ? listed * kSleepBlock : count;
}
constexpr int64_t kTerms = 128;  // of past steps that are kept, a power of 2; no block may miss as many
constexpr int kTermColumns = 8;

// What binning reads of a splat. It fits one memory sector, because binning reads splats in depth order. On a GPU
// binning makes records that it was not given.
struct alignas(16) TileRecord {
  uint64_t reached;         // a bit for each tile of a rectangle of at most 64, row by row; else the number reached
  uint16_t x0, y0, x1, y1;  // empty where the splat reaches no tile
};

template <class T>
struct Projected {
  // (N, splat_row(rays)), Splat in math/splat.h or what derives from it. Where tile_counts is 0 it is undefined; or
  // with Scene::keeps_shapes its colour is, and culled ones have a log2_opacity of -inf and nothing else.
  T* splats;
  T* depths;       // (N) infinite where tile_counts is 0, so that binning sorts those last
  int32_t* rects;  // (N, 4) tiles x0 y0 x1 y1, undefined where tile_counts is 0; null allowed if there are records
  int32_t* tile_counts;      // (N)
  int32_t* radii;            // (N)
  TileRecord* records;       // (N), or null
  Rays rays = kNoRays;       // what splats are, here and below
  const T* table = nullptr;  // of a lens with rays (math/lens_pixels.h), here and below
};

// Gradients of the inputs that have one, in the order of Input in torch/scene.h; null where not wanted.
template <class T>
struct SceneGradient {
  T* means;
  T* means2d;  // (N, 3): x and y per NDC unit, then 0
  T* opacities;
  T* scales;
  T* rotations;
  T* cov3d;
  T* colors;
  T* sh_dc;
  T* sh_rest;
};

// The slots (math/slots.h) of a splat: one for each tile of its rectangle, row by row. A culled splat has none.
struct alignas(16) SplatSlots {
  int64_t first;    // the number of slots of all splats before
  int32_t skipped;  // tiles before the rectangle if every row of the image were as wide as the rectangle
  int32_t wide;     // the rectangle's width
};

// What lists may hold, or what they need: instances, slots, gradient rows (a processed instance has one), and blocks
// of Gaussians that are awake.
struct Room {
  int64_t instances, slots, rows, blocks;
};

// How far a host may run ahead of a GPU: it gives room for lists whose lengths it does not know. If one is too long,
// the step halts, and all later ones do nothing until the host has made room (Queue::halted).
struct Ahead {
  int32_t* halted;  // on the device: the step that lacked room, else 0
  Room* needed;     // on the device: of the last step that was not halted before
  int64_t* done;    // on the device: the number of steps that were done
  Room room;
  int64_t* reports;  // (report_count, 6) page-locked: of a step its needs, halted, and its number; or null
  int report_count;  // step n, counted from 1, writes report n % report_count
};

struct Binned {
  int32_t* instances;  // (I) the splat; sorted by tile, then by depth, then by index
  int64_t* ranges;     // (tiles + 1) into instances
};

// Values that splats show in place of colours, any number of them. Then there are no inverse depth and no layers.
template <class T>
struct Channels {
  const T* values = nullptr;      // (N, stride), the first splat's
  int64_t stride = 0, count = 0;  // 0: splats show colours
  T cap = 0;                      // the largest alpha
  bool stops = false;             // whether a gradient ends at the cap
  // Of an image and of its gradient: values from a channel to the next, and from a pixel to the next.
  int64_t plane = 0, pixel = 1;

  const T* of(int64_t splat) const { return values + stride * splat; }
};

template <class T>
struct BlendInput {
  const T* splats;
  const int32_t* instances;
  const int64_t* ranges;
  const T* background;  // (C)
  Image image;
  int64_t instance_count;  // where the ranges end, or more
  Rays rays = kNoRays;
  const T* table = nullptr;
  Channels<T> channels = {};

  int64_t planes() const { return channels.count ? channels.count : 3; }  // C, of an image and of its gradient
};

template <class T>
struct Blended {
  T* color;            // (C, H, W)
  T* transmittance;    // (H, W)
  T* inverse_depth;    // (H, W), or null
  int32_t* last;       // (H, W) 1 + position in the tile's list of the last splat blended, or null
  T* layers;           // math/layers.h, for the backward; null allowed, and on the CPU
  T* alpha = nullptr;  // (H, W) of channels: 1 - transmittance; or null
};

// Blending takes so many channels at once; of more, there are several passes.
constexpr int kMostChannels = 32;

// Calls run(first, pass, begin) for each pass over channels: where its channels begin, and where they do in an image.
template <class T, class Run>
void each_pass(const BlendInput<T>& in, const Run& run) {
  for (int64_t first = 0; first < in.channels.count; first += kMostChannels) {
    const int64_t left = in.channels.count - first;
    BlendInput<T> pass = in;
    pass.background += first, pass.channels.values += first;
    pass.channels.count = left < kMostChannels ? left : kMostChannels;
    run(first, pass, first * in.channels.plane);
  }
}

template <class T>
struct BlendGradient {
  int64_t count, instance_count, slot_count;
  const SplatSlots* slots;
  const T* transmittance;
  const int32_t* last;
  const T* color;                   // dLoss/dcolor
  const T* inverse_depth;           // dLoss/dinverse_depth, or null
  const T* transmittance_gradient;  // or null
  T* moments;  // out: (N, 10), Moments in math/footprint.h, then colour and inverse depth; (N, 14) for RayMoments
  const T* layers = nullptr;     // Blended::layers, or null: then blend_vjp makes its own
  const Ahead* ahead = nullptr;  // on a GPU: take room for gradient rows, and do not wait for their number
  T* absolute = nullptr;         // out: (N), absolute_length in math/absolute.h; or null
  T* values = nullptr;           // out: (N, channels), of Channels::values; or null

  // Up to three channels are in the moments, in place of a colour.
  bool values_apart(const Channels<T>& channels) const { return values && channels.count > 3; }
};

// Gradient rows that lie by splat: those of a splat side by side, in the order of its slots.
template <class T>
struct SplatRows {
  int64_t count;
  const int32_t* tile_counts;  // (N)
  const int32_t* counts;       // (N) rows of each splat; 0 where tile_counts is 0
  const T* rows;      // (R, 10) as in BlendGradient::moments, or 14; two more for lengths of absolute gradients
  int64_t row_count;  // R
  Rays rays = kNoRays;
};

// Where the sums of a splat's rows go, and what lengths of absolute gradients need besides.
template <class T>
struct RowSums {
  const T* splats;  // not read without `absolute`
  Image image;
  T *moments, *absolute;  // as in BlendGradient; `absolute` null unless the rows have its values
};

// A tensor that takes a step of Adam in place, in the `columns` leading values of each row.
template <class T>
struct AdamInput {
  T* value;
  const T* gradient;
  T* mean;    // of the gradients: exp_avg
  T* square;  // mean of their squares: exp_avg_sq
  int64_t rows, row, columns;
  double lr, beta1, beta2, eps, step;
};

// Stops a training for good at the first step that is not finite. With `stopped` null it never does.
template <class T>
struct StepGuard {
  const T* loss;     // scalar; if it is not finite, no step is taken
  int64_t* stopped;  // the first iteration whose loss or step was not finite, else 0; later iterations take no step
  int64_t iteration;
};

// A view to add to the statistics of density control.
struct ObserveInput {
  int64_t count;
  float *max_radii, *gradient_sums, *views;  // (N), updated: Observed in math/observe.h
  const int32_t* radii;                      // (N) of this view
  const float* gradients;                    // (N, 3) of the means on the screen; the third value is not read
  const float* lengths = nullptr;            // (N) what stands for the gradients' lengths; or null
  const int32_t* blocks = nullptr;  // radii, gradients and lengths are of these blocks (Scene::blocks); or null
};

// Gaussians that move at random (math/displace.h): by noise, or to the children of split ones.
struct Displacement {
  int64_t count;
  float* means;                         // (N, 3), updated
  const float *log_scales, *rotations;  // (N, 3), (N, 4) wxyz
  const float* logits = nullptr;        // (N), of noise
  const int64_t* items = nullptr;  // (N) indices in the model of split ones; with what follows they decide the numbers
  double size = 0, steepness = 0, threshold = 0;
  uint64_t seed = 0;
  uint32_t draw = 0, iteration = 0, stream = 0;
  const int64_t* stopped = nullptr;  // nothing happens once it (StepGuard) is not 0; or null
  int64_t first = 0;                 // index of the first one where there are no items
};

// A function of each number (math/portable.h).
struct Elementary {
  int64_t count;
  const double* values;
  double* out;
  bool logarithm;  // else an exponential
};

// Four random words for each item (math/random.h).
struct RandomInput {
  int64_t count;
  const int64_t* items;
  int64_t* out;  // (count, 4)
  uint64_t seed = 0;
  uint32_t draw = 0, iteration = 0, stream = 0;
};

// Which splats reach which bands of rows of tiles. A record is a splat for a band that it reaches.
struct RecordInput {
  int64_t count;
  int bands;
  const int32_t* rects;        // (N, 4), undefined where there are no tiles
  const int32_t* tile_counts;  // (N)
  const int32_t* limits;       // (2, bands): rows of tiles where each begins, and where it ends
};

// Records, ascending by splat for each band, band after band.
template <class T>
struct RecordLists {
  int64_t room;  // records without room are left out
  int row;       // values of a splat
  // (bands + 1, record_blocks + 1): how many count_records found, and in one more block how many empty records each
  // band gets behind its own. They are zeros, and of no splat: number N.
  const int32_t* counts;
  const T *splats, *depths;      // (N, row) and (N)
  int64_t* gaussians;            // (room) written, as is all that follows: the splat's number
  int32_t* places;               // (room) the record's number by splat, then by band
  T *new_splats, *new_depths;    // (room, row) and (room)
  int32_t *rects, *tile_counts;  // (room, 4) and (room)
};

// Records are counted in blocks of so many splats.
constexpr int64_t kRecordBlock = 256;
constexpr int64_t record_blocks(int64_t count) { return (count + kRecordBlock - 1) / kRecordBlock; }

// Runs of rows that lie side by side, some of which become one row each, the sum of theirs.
template <class T>
struct SumInput {
  int64_t runs, rows, room;         // rows: all of all runs; room: rows of `to`
  int values;                       // of a row: 10 or 12
  const int32_t* counts;            // (runs) rows of each run
  const int32_t* kept;              // (runs) 1: their sum, also of no rows; 0: nothing; else all of them
  const T* from;                    // (rows, values)
  T* to;                            // (room, values), written as far as `kept` goes
  const int32_t* places = nullptr;  // (runs) the number of each run in the order of `to`; null: the same order
};

// Weights of a Gaussian's opacity and of each of its scales in the loss (math/penalty.h).
template <class T>
struct Penalty {
  T opacity, scale;
  bool any() const { return opacity != 0 || scale != 0; }
};

// Gradients to which those of a penalty are added.
template <class T>
struct PenaltyInput {
  int64_t count;
  Penalty<T> penalty;
  const T *logits, *log_scales;              // (N) and (N, 3)
  T *logit_gradients, *log_scale_gradients;  // the same, updated
};

// The parameters of a Gaussian that take steps.
enum Stepped { kStepMeans, kStepOpacities, kStepScales, kStepRotations, kStepShDc, kStepShRest, kStepped };

// What changes from step to step, in the device's memory, so that a step can be recorded once and taken often.
struct StepNow {
  float constants[kStepped][7];  // AdamStep in math/adam.h of each attribute
  int64_t iteration;             // of the guard
  int64_t step;                  // its number, from 1
};

// The step that every Gaussian takes as soon as its gradients are known, so that these never reach memory. The values
// are those of the Scene, and change in place: a Gaussian's row is read before it is written, and no other reads it.
// Blocks that sleep (Scene::awake) take no step.
template <class T>
struct GaussianStep {
  AdamInput<T> attributes[kStepped];  // the gradients are not read; without columns an attribute takes no step
  const StepNow* now;                 // stands in for rates, steps and the guard's iteration; or null
  StepGuard<T> guard;
  bool sparse;            // only Gaussians of observed.radii above 0 take a step, and without bias correction
  ObserveInput observed;  // the view's gradients are not read; with max_radii null nothing is observed
  Penalty<T> penalty;     // whose gradients are added, where opacities and scales take steps
  double* camera;         // the gradients of the camera's numbers (math/camera_gradient.h), before the step; or null
};

// The blocks of Gaussians that sleep (math/sleep.h) through a step. Blocks that wake take the steps before it that they
// have missed. step: its attributes, guard and `now`.
template <class T>
struct SleepInput {
  GaussianStep<T> step;
  bool all;        // all blocks wake, or those that a view may show; none where the guard has stopped
  bool rests;      // no step follows yet
  uint8_t* awake;  // (blocks) written
  int32_t* taken;  // (blocks) the number of the last step that a block takes part in: this one, unless it rests
  // (kTerms, kTermColumns): of each attribute lr sqrt(1 - beta2^s) / (1 - beta1^s) of step s, in row s modulo kTerms.
  T* terms;
  int32_t* blocks = nullptr;  // (room) written on a GPU unless all wake: those that are awake (Scene::blocks)
  int64_t room = 0;
  const Ahead* ahead = nullptr;  // judges whether there is room for them
};

}  // namespace gs
