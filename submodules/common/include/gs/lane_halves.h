#pragma once
// Sums over the lanes of several vectors, and turned squares of values, by steps that join halves of two vectors.
#include <algorithm>
#include <utility>

#include "gs/simd.h"

GS_ISA_BEGIN

// Of each part of 2 kSide lanes the low (kHigh = 0) or high (1) half, those of a and b in turn.
template <class S, int kSide, int kHigh>
class LaneHalves {
  using Vec = typename S::Vec;

 public:
  static Vec of(Vec a, Vec b) { return taken(a, b, std::make_integer_sequence<int, S::kLanes>()); }

 private:
  template <int... kLane>
  static Vec taken(Vec a, Vec b, std::integer_sequence<int, kLane...>) {
#ifdef __clang__
    return __builtin_shufflevector(a, b, source(kLane)...);
#else
    return __builtin_shuffle(a, b, typename S::Mask{source(kLane)...});
#endif
  }
  static constexpr int source(int lane) {
    const int within = (lane & ~kSide) + kHigh * kSide;
    return lane & kSide ? S::kLanes + within : within;
  }
};

// A vector's lanes are added by halves: lane i to lane i + kLanes / 2, and so on with what is left. This tree is the
// same for all vectors, and turning the lanes round in a circle changes no sum.
template <class T, int kBytes>
class LaneSums {
  using S = Simd<T, kBytes>;
  using Vec = typename S::Vec;

 public:
  // out[i] = the sum of v[i]'s lanes.
  template <int kCount>
  static void store(const Vec (&v)[kCount], T* out) {
    if constexpr (S::kLanes > 8) {  // additions of half the width cost less than shuffles of the whole
      using Half = Simd<T, kBytes / 2>;
      typename Half::Vec halves[kCount];
      for (int i = 0; i < kCount; ++i) {
        typename Half::Vec low, high;
        std::memcpy(&low, &v[i], sizeof low);
        std::memcpy(&high, reinterpret_cast<const char*>(&v[i]) + sizeof low, sizeof high);
        halves[i] = low + high;
      }
      LaneSums<T, kBytes / 2>::store(halves, out);
    } else {
      T sums[(kCount + S::kLanes - 1) / S::kLanes * S::kLanes];
      fold<S::kLanes>(v, sums);
      for (int i = 0; i < kCount; ++i) out[i] = sums[i / S::kLanes * S::kLanes + reversed(i % S::kLanes)];
    }
  }

 private:
  // Each part of kPart lanes belongs to one sum. A step halves the parts and puts two vectors into one, so in the end
  // the number of a sum's lane has the bits of the sum's number in reverse.
  template <int kPart, int kCount>
  static void fold(const Vec (&v)[kCount], T* sums) {
    if constexpr (kPart == 1) {
      for (int i = 0; i < kCount; ++i) S::store(sums + i * S::kLanes, v[i]);
    } else {
      Vec folded[(kCount + 1) / 2];
      for (int i = 0; i < kCount; i += 2) {
        const Vec a = v[i], b = v[std::min(i + 1, kCount - 1)];
        folded[i / 2] = LaneHalves<S, kPart / 2, 0>::of(a, b) + LaneHalves<S, kPart / 2, 1>::of(a, b);
      }
      fold<kPart / 2>(folded, sums);
    }
  }

  static constexpr int reversed(int number) {
    int out = 0;
    for (int bit = 1; bit < S::kLanes; bit *= 2) out = 2 * out + (number & bit ? 1 : 0);
    return out;
  }
};

// Turns a square of values: as many vectors as a vector has lanes.
template <class T>
class LaneTranspose {
  using S = Simd<T>;
  using Vec = typename S::Vec;

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
        v[i] = LaneHalves<S, kSide, 0>::of(a, b), v[i + kSide] = LaneHalves<S, kSide, 1>::of(a, b);
      }
      swap<kSide / 2>(v);
    }
  }
};

GS_ISA_END
