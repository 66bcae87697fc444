#pragma once
// The functions that the backends offer.
#include "data.h"
#include "gs/cuda_queue.h"
#include "gs/isa.h"
#include "gs/parallel.h"

namespace gs {

void composite(const Composite&, const Executor&);  // compiled once: see gs/rounded.h
void composite(const Composite&, const Queue&);

void l1_ssim_cuda(const L1SsimCuda&, const Queue&);
void l1_ssim_means_cuda(const L1SsimCuda&, const Queue&);  // from the sums of all bands
void l1_ssim_vjp_cuda(const L1SsimVjpCuda&, const Queue&);

#define GS_DECLARE(isa)                                            \
  namespace isa {                                                  \
  void l1_ssim_cpu(const L1Ssim<float>&, const Executor&);         \
  void l1_ssim_cpu(const L1Ssim<double>&, const Executor&);        \
  void l1_ssim_means_cpu(const L1SsimMeans<float>&);               \
  void l1_ssim_means_cpu(const L1SsimMeans<double>&);              \
  void l1_ssim_vjp_cpu(const L1SsimVjp<float>&, const Executor&);  \
  void l1_ssim_vjp_cpu(const L1SsimVjp<double>&, const Executor&); \
  }
GS_EACH_ISA(GS_DECLARE)
#undef GS_DECLARE

}  // namespace gs
