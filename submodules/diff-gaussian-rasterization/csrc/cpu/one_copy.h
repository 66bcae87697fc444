#pragma once
// A compiler must neither inline nor clone what has this mark: each copy could fuse other products, and gradients must
// have the same bits whether they are written or stepped.
#ifdef __clang__
#define GS_ONE_COPY __attribute__((noinline))
#else
#define GS_ONE_COPY __attribute__((noipa))
#endif
