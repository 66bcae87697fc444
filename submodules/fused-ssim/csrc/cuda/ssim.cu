// L1 and SSIM with the gradient of SSIM, in one walk over the images. A block walks down a strip (ssim_strip.h) and
// sums in double. A last block adds the blocks' sums in order, so the same images give the same bits.
#include "backend.h"
#include "cuda/ssim_strip.h"
#include "gs/cuda_check.h"

namespace gs {
namespace {

using namespace GS_ISA;

// Sums over the block in a fixed tree; thread 0 gets the sum. All threads call this once.
template <int kBlock>
__device__ Sums block_sum(Sums own) {
  __shared__ Sums warps[kBlock / 32];
  for (int offset = 16; offset > 0; offset /= 2) {
    own.l1 += __shfl_down_sync(~0u, own.l1, offset);
    own.ssim += __shfl_down_sync(~0u, own.ssim, offset);
  }
  if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = own;
  __syncthreads();
  Sums all{};
  if (threadIdx.x == 0)
    for (const Sums& warp : warps) {
      all.l1 += warp.l1;
      all.ssim += warp.ssim;
    }
  return all;
}

template <class Source, bool kGradient>
__global__ void __launch_bounds__(kThreads, 3)
    l1_ssim_kernel(ImagePair<float> images, Cut cut, bool valid, float gradient_scale, float* gradient, Sums* sums) {
  extern __shared__ Four memory[];
  Strip& strip = *reinterpret_cast<Strip*>(memory);
  const int thread = threadIdx.x;
  const Part part = part_of(cut, images.height, images.width, valid, blockIdx.x);
  const int64_t plane = blockIdx.x / (cut.across * cut.down(images.height)) * images.height * images.width;
  const float* img1 = images.img1 + plane;
  const Source* img2 = static_cast<const Source*>(images.img2) + plane;

  Sums own{};
  for (int first = 0; first < kRing; first += kStep)
    put(strip, part, load(part, img1, img2, images.clamp, first, thread), first, kRing, thread, own);
  __syncthreads();
  const int steps = step_count(part.rows);
  for (int step = 0; step < steps; ++step) {
    column_stats(strip, step, thread);
    __syncthreads();
    window_row<kGradient>(strip, part, step, thread, own);
    __syncthreads();
    if constexpr (kGradient) {
      gather_down(strip, step, thread);
      __syncthreads();
    }
    const int next = step * kStep + kRing;
    const Rows rows = load(part, img1, img2, images.clamp, next, thread);  // they arrive while the gradient is computed
    if constexpr (kGradient) gather_across(strip, thread);
    put(strip, part, rows, next, next + kStep, thread, own);
    __syncthreads();
    if constexpr (kGradient) write_gradient(strip, part, step, gradient_scale, gradient + plane, thread);
  }
  const Sums all = block_sum<kThreads>(own);
  if (thread == 0) sums[blockIdx.x] = all;
}

constexpr int kSumThreads = 256;

__global__ void mean_kernel(const Sums* sums, int64_t n, double l1_count, double ssim_count, L1SsimCuda out) {
  Sums own{};
  for (int64_t i = threadIdx.x; i < n; i += kSumThreads) {
    own.l1 += sums[i].l1;
    own.ssim += sums[i].ssim;
  }
  const Sums all = block_sum<kSumThreads>(own);
  if (threadIdx.x == 0) {
    const float l1 = float(all.l1 / l1_count), ssim = float(all.ssim / ssim_count);
    *out.l1 = l1;
    if (out.ssim) *out.ssim = ssim;
    if (out.loss) *out.loss = out.l1_weight * l1 + out.dssim_weight * (1 - ssim);
  }
}

template <class Source, bool kGradient>
void l1_ssim(const L1SsimCuda& args, const Queue& queue) {
  const auto& images = args.images;
  const auto stream = static_cast<cudaStream_t>(queue.stream);
  const Cut cut = Cut::of(images.planes, images.height, images.width);
  if (cut.parts > INT32_MAX) throw std::runtime_error("the images have too many planes for one call: pass fewer");
  const int64_t rim = args.valid ? kReach : 0;
  const double l1_count = double(images.planes) * double(images.height) * double(images.width);
  const double ssim_count = double(images.planes) * double(images.height - rim) * double(images.width - rim);
  Sums* sums = queue.array<Sums>(cut.parts);
  const auto kernel = l1_ssim_kernel<Source, kGradient>;
  GS_CUDA_CHECK(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(sizeof(Strip))));
  kernel<<<unsigned(cut.parts), kThreads, sizeof(Strip), stream>>>(images, cut, args.valid, float(1 / ssim_count),
                                                                   args.gradient, sums);
  check_launch("l1_ssim_kernel");
  mean_kernel<<<1, kSumThreads, 0, stream>>>(sums, cut.parts, l1_count, ssim_count, args);
  check_launch("mean_kernel");
}

constexpr int kVjpThreads = 256;
constexpr int kVjpPixels = 4;  // of a thread, kVjpThreads apart: their loads overlap, whatever the alignment

template <class Source>
__global__ void __launch_bounds__(kVjpThreads) l1_ssim_vjp_kernel(L1SsimVjpCuda args, int64_t n, double mean) {
  const float by_l1 = float(double(*args.grad_l1 * args.l1_weight) * mean);
  const float by_ssim = *args.grad_ssim * args.ssim_weight;
  const Source* img2 = static_cast<const Source*>(args.images.img2);
  const int64_t first = int64_t(blockIdx.x) * (kVjpThreads * kVjpPixels) + threadIdx.x;
  GS_UNROLL
  for (int i = 0; i < kVjpPixels; ++i) {
    const int64_t at = first + i * kVjpThreads;
    if (at < n) {
      const float x1 = args.images.img1[at];
      const float sum = by_ssim * args.ssim_gradient[at] + by_l1 * abs_difference_vjp(x1, to_float(img2[at]));
      args.grad_img1[at] = args.images.clamp && !in_unit(x1) ? 0 : sum;
    }
  }
}

template <class Source>
void l1_ssim_vjp(const L1SsimVjpCuda& args, const Queue& queue) {
  const int64_t n = args.images.planes * args.images.height * args.images.width;
  const int64_t blocks = (n + kVjpThreads * kVjpPixels - 1) / (kVjpThreads * kVjpPixels);
  if (blocks > INT32_MAX) throw std::runtime_error("the images have too many pixels for one call: pass fewer planes");
  l1_ssim_vjp_kernel<Source>
      <<<unsigned(blocks), kVjpThreads, 0, static_cast<cudaStream_t>(queue.stream)>>>(args, n, 1 / double(n));
  check_launch("l1_ssim_vjp_kernel");
}

}  // namespace

void l1_ssim_cuda(const L1SsimCuda& args, const Queue& queue) {
  if (args.images.img2_is_bytes)
    args.gradient ? l1_ssim<uint8_t, true>(args, queue) : l1_ssim<uint8_t, false>(args, queue);
  else
    args.gradient ? l1_ssim<float, true>(args, queue) : l1_ssim<float, false>(args, queue);
}

void l1_ssim_vjp_cuda(const L1SsimVjpCuda& args, const Queue& queue) {
  args.images.img2_is_bytes ? l1_ssim_vjp<uint8_t>(args, queue) : l1_ssim_vjp<float>(args, queue);
}

}  // namespace gs
