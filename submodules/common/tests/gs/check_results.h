#pragma once
// Results of a run as a file, so that instruction sets, systems and compilers can be compared, by bytes or within
// bounds.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <limits>
#include <random>
#include <type_traits>
#include <vector>

#include "gs/check.h"

namespace gs {

// Numbers that are alike everywhere, which those of the standard's distributions are not.
class SameNumbers {
 public:
  double uniform() { return bits_() * 0x1p-32; }
  double spread() { return uniform() + uniform() + uniform() + uniform() - 2; }  // about normal, deviation 0.58

 private:
  std::mt19937 bits_{4};
};

// The program's arguments are the file to write and perhaps a file of another run, to compare with within bounds.
class Results {
 public:
  Results(int argc, char** argv) : out_(argc > 1 ? argv[1] : "", std::ios::binary), compares_(argc > 2) {
    CHECK(out_);
    if (compares_) other_.open(argv[2], std::ios::binary);
  }

  template <class T>
  void add(const char* name, const std::vector<T>& values) {
    const auto size = std::streamsize(values.size() * sizeof(T));
    out_.write(reinterpret_cast<const char*>(values.data()), size);
    if (!compares_) return;
    std::vector<T> wanted(values.size());
    CHECK(other_.read(reinterpret_cast<char*>(wanted.data()), size));
    compare(name, values, wanted);
  }

  int finish(const char* name) {
    CHECK(out_.flush());
    CHECK(!compares_ || other_.peek() == std::ifstream::traits_type::eof());
    if (compares_)
      std::cout << unequal_ << " of " << compared_ << " values differ, floats by " << furthest_float_
                << " and doubles by " << furthest_double_ << " of the largest value at most\n";
    return finish_tests(name);
  }

 private:
  // Whole numbers may differ by 1. Of others all but 1 in 1000 lie within rounding of the largest: a few pixels may
  // fall to the other side of a splat's edge, where alpha is 1/255.
  template <class T>
  void compare(const char* name, const std::vector<T>& values, const std::vector<T>& wanted) {
    constexpr double kRounding = std::is_same_v<T, float> ? 2e-5 : 5e-14;
    const bool whole = std::is_integral_v<T>;
    double largest = 1e-300, furthest = 0;
    size_t far = 0;
    for (T value : wanted) largest = std::max(largest, std::abs(double(value)));
    for (size_t i = 0; i < values.size(); ++i) {
      const double distance = std::abs(double(values[i]) - double(wanted[i]));
      unequal_ += distance != 0, furthest = std::max(furthest, distance);
      far += !(distance <= (whole ? 1 : kRounding * largest));
    }
    compared_ += values.size();
    const bool near = far * 1000 <= values.size() && furthest <= (whole ? 1 : 0.02 * largest);
    CHECK(near);
    if (!near) std::cerr << name << ": " << far << " values differ, by " << furthest / largest << " of the largest\n";
    double& kind = sizeof(T) == 4 ? furthest_float_ : furthest_double_;
    kind = std::max(kind, whole ? 0 : furthest / largest);
  }

  std::ofstream out_;
  std::ifstream other_;
  bool compares_;
  size_t compared_ = 0, unequal_ = 0;
  double furthest_float_ = 0, furthest_double_ = 0;  // relative to the largest of its kind
};

}  // namespace gs
