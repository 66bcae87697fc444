#pragma once
// Several instruction sets in one library. Every csrc/cpu/*_isa.cpp is compiled once for each of them. All of its code,
// math headers included, lives in a namespace of that instruction set: the linker could take a symbol that two of them
// share from the wrong one, which would fault on an older machine.
#include <cstdlib>
#include <cstring>

#ifndef GS_ISA
#define GS_ISA baseline
#endif
#define GS_ISA_BEGIN \
  namespace gs {     \
  namespace GS_ISA {
#define GS_ISA_END \
  }                \
  }

// GS_NEON: 64-bit Arm, with vectors of its own. GS_PLAIN takes them away, for its baseline: no instruction of one
// machine alone, and each product rounded (the compiler's flag), so its results have the bits of x86-64's baseline.
#if defined(__ARM_NEON) && defined(__aarch64__) && !defined(GS_PLAIN)
#define GS_NEON
#endif
// GS_FUSES: a product and a sum are one instruction, rounded once.
#if defined(__FMA__) || defined(GS_NEON)
#define GS_FUSES
#endif

// A compiler must neither inline nor clone what has this mark: each copy could fuse other products, and gradients must
// have the same bits whether they are written or stepped.
#ifdef __clang__
#define GS_ONE_COPY __attribute__((noinline))
#else
#define GS_ONE_COPY __attribute__((noipa))
#endif

// GS_EACH_ISA(use): use(isa) for each instruction set of the library. The builder defines GS_X86 or GS_ARM64.
#if defined(GS_X86)
#define GS_EACH_ISA(use) use(baseline) use(avx2) use(avx512)
#elif defined(GS_ARM64)
#define GS_EACH_ISA(use) use(baseline) use(neon)
#else
#define GS_EACH_ISA(use) use(baseline)
#endif

namespace gs {

enum class Isa { baseline, avx2, avx512, neon };

// The widest instruction set of this machine, or a narrower one that the environment variable GS_ISA names, to compare
// them. Internal linkage, for the reason above.
static inline Isa best_isa() {
  static const Isa isa = [] {
    Isa found = Isa::baseline;
#if defined(GS_ARM64)
    found = Isa::neon;  // every 64-bit Arm has it
#elif defined(GS_X86)
    // x86-64-v3 and v4 by their parts: compilers before GCC 12 and Clang 16 do not know the levels' names.
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"))
      found = Isa::avx2;
    if (found == Isa::avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd"))
      found = Isa::avx512;
#endif
    const char* wanted = std::getenv("GS_ISA");
    if (wanted && !std::strcmp(wanted, "baseline")) return Isa::baseline;
    if (wanted && !std::strcmp(wanted, "avx2") && found == Isa::avx512) return Isa::avx2;
    return found;
  }();
  return isa;
}

}  // namespace gs

// Calls gs::<isa>::fn(...) for the instruction set of this machine.
#if defined(GS_X86)
#define GS_DISPATCH(fn, ...)                                             \
  (::gs::best_isa() == ::gs::Isa::avx512 ? ::gs::avx512::fn(__VA_ARGS__) \
   : ::gs::best_isa() == ::gs::Isa::avx2 ? ::gs::avx2::fn(__VA_ARGS__)   \
                                         : ::gs::baseline::fn(__VA_ARGS__))
#elif defined(GS_ARM64)
#define GS_DISPATCH(fn, ...) \
  (::gs::best_isa() == ::gs::Isa::neon ? ::gs::neon::fn(__VA_ARGS__) : ::gs::baseline::fn(__VA_ARGS__))
#else
#define GS_DISPATCH(fn, ...) ::gs::baseline::fn(__VA_ARGS__)
#endif
