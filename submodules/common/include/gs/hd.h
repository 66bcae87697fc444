#pragma once
// The mark of functions that both the host compiler and nvcc compile.
#ifdef __CUDACC__
#define GS_HD __host__ __device__ inline
#else
#define GS_HD inline
#endif
