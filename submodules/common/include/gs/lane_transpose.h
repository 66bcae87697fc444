#pragma once
// Turns a square of values: as many vectors as a vector has lanes.
#include <utility>

#include "gs/simd.h"

GS_ISA_BEGIN

template <class T>
class LaneTranspose {
  using S = Simd<T>;
  using Vec = typename S::Vec;
  using Lanes = std::make_integer_sequence<int, S::kLanes>;

 public:
  // Lane j of v[i] becomes lane i of v[j].
  static void run(Vec (&v)[S::kLanes]) { swap<S::kLanes / 2>(v); }

 private:
  // Swaps the squares of kSide beside the diagonal of all squares of twice the side.
  template <int kSide>
  static void swap(Vec (&v)[S::kLanes]) {
    if constexpr (kSide > 0) {
      for (int i = 0; i < S::kLanes; ++i) {
        if (i & kSide) continue;
        const Vec a = v[i], b = v[i + kSide];
        v[i] = half<kSide, 0>(a, b, Lanes()), v[i + kSide] = half<kSide, 1>(a, b, Lanes());
      }
      swap<kSide / 2>(v);
    }
  }

  // The low (0) or high (1) parts of kSide lanes, those of a and b in turn.
  template <int kSide, int kHigh, int... kLane>
  static Vec half(Vec a, Vec b, std::integer_sequence<int, kLane...>) {
#ifdef __clang__
    return __builtin_shufflevector(a, b, source(kLane, kSide, kHigh)...);
#else
    return __builtin_shuffle(a, b, typename S::Mask{source(kLane, kSide, kHigh)...});
#endif
  }
  static constexpr int source(int lane, int side, int high) {
    const int within = (lane & ~side) + high * side;
    return lane & side ? S::kLanes + within : within;
  }
};

GS_ISA_END
