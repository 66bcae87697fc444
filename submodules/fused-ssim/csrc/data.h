#pragma once
// The plain structs of pointers and sizes that every backend takes.
#include <cstdint>

namespace gs {

// `planes` images of one channel, height x width, contiguous, row by row.
template <class T>
struct ImagePair {
  const T* img1;
  const void* img2;  // T, or uint8_t that means value / 255
  bool img2_is_bytes;
  int64_t planes, height, width;
  bool clamp = false;  // use img1 clamped to [0, 1]; it has no gradient outside
};

// Rows of every plane. A band of an image begins at a multiple of kBandRows, and ends at one or with the image.
struct RowRange {
  int64_t begin, end;
};
constexpr int64_t kBandRows = 16;

// With `rows`, only their sums and gradients are written, to the places that they have in those of the whole image, and
// no means. Pixels more than 2 kRadius rows away count for nothing.
template <class T>
struct L1Ssim {
  ImagePair<T> images;
  bool valid;    // leave the rim of kRadius pixels out of the mean of SSIM
  double* l1;    // out: mean of |img1 - img2|, over all pixels
  double* ssim;  // out: mean of SSIM
  T* gradient;   // out, like img1: d ssim / d img1, clamped or not; null if not wanted
  const RowRange* rows = nullptr;
  double* sums = nullptr;  // with rows, out: (planes, height, row_parts, 2), of |img1 - img2| and of SSIM
};

// From the sums of all rows, the means that the whole image has.
template <class T>
struct L1SsimMeans {
  ImagePair<T> images;
  const double* sums;  // L1Ssim::sums
  double *l1, *ssim;   // out
};

// Parts of a row whose sums are taken apart on the CPU.
template <class T>
constexpr int64_t kRowPart = 2048 / sizeof(T);
template <class T>
constexpr int64_t row_parts(int64_t width) {
  return (width + kRowPart<T> - 1) / kRowPart<T>;
}

template <class T>
struct L1SsimVjp {
  ImagePair<T> images;
  const T* ssim_gradient;  // L1Ssim::gradient
  double grad_l1, grad_ssim;
  T* grad_img1;                    // out
  const RowRange* rows = nullptr;  // that are wanted; the others may get any value
};

// L1SsimCuda::maps are (planes, strips, map_rows, kMapRow) floats. Each strip has kMapColumns columns of a plane.
constexpr int kMapColumns = 116, kMapRow = 408;
constexpr int64_t map_strips(int64_t width) { return (width + kMapColumns - 1) / kMapColumns; }
// The rows that the maps of a band have: those of the windows' blocks that its gradient reads.
inline RowRange map_rows(RowRange band, int64_t height) {
  constexpr int64_t kBlock = 8;
  if (band.begin >= band.end) return {band.begin, band.begin};
  return {band.begin < kBlock ? 0 : band.begin - kBlock, height - band.end < kBlock ? height : band.end + kBlock};
}
// Sums of each block of pixels, of |img1 - img2| and of 1 - SSIM: (sum_blocks, 2).
int64_t sum_blocks(int64_t planes, int64_t height, int64_t width);

// As L1Ssim<float>, with every pointer to the device.
struct L1SsimCuda {
  ImagePair<float> images;
  bool valid;
  float *l1, *ssim;       // ssim null if not wanted
  float* maps;            // out: what the gradient needs; null if not wanted
  float* loss = nullptr;  // out: l1_weight l1 + dssim_weight (1 - ssim); null if not wanted
  float l1_weight = 0, dssim_weight = 0;
  const RowRange* rows = nullptr;  // of the host
  double* sums = nullptr;          // with rows, out, and those of other blocks stay as they are; in for l1_ssim_means
};

// As L1SsimVjp<float>, with every pointer to the device.
struct L1SsimVjpCuda {
  ImagePair<float> images;
  const float *maps, *grad_l1, *grad_ssim;  // L1SsimCuda::maps
  float* grad_img1;
  float l1_weight = 1, ssim_weight = 1;  // of grad_l1 and grad_ssim
  const RowRange* rows = nullptr;        // that are written, and whose maps these are
};

// An image with alpha, to be composited on a background.
struct Composite {
  const uint8_t* picture;   // (4, pixels): red, green, blue, straight alpha
  const float* background;  // 3
  int64_t pixels;
  float* out;  // (3, pixels)
};

}  // namespace gs
