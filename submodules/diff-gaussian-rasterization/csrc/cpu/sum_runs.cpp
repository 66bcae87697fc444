// Adds up runs of gradient rows before they go to other processes.
#include <algorithm>
#include <vector>

#include "../backend.h"
#include "../math/absolute.h"
#include "../math/splat.h"

namespace gs {

using baseline::kAbsoluteValues, baseline::kGradientValues;

// The sums are those of sum_rows (blend_vjp_isa.cpp), to which adding up a single row changes nothing.
template <class T>
void sum_runs(const Executor& executor, const SumInput<T>& in) {
  std::vector<int64_t> begins(in.runs + 1, 0), new_begins(in.runs + 1, 0);
  const auto place = [&](int64_t i) { return in.places ? int64_t(in.places[i]) : i; };
  for (int64_t i = 0; i < in.runs; ++i) begins[i + 1] = begins[i] + in.counts[i], new_begins[place(i) + 1] = in.kept[i];
  for (int64_t i = 0; i < in.runs; ++i) new_begins[i + 1] += new_begins[i];
  for_each_row(executor, in.runs, 4096, [&](int64_t i) {
    const T *from = in.from + in.values * begins[i], *stop = in.from + in.values * begins[i + 1];
    T* to = in.to + in.values * new_begins[place(i)];
    if (in.kept[i] != 1) {
      std::copy_n(from, in.values * int64_t(in.kept[i]), to);
      return;
    }
    double sums[kGradientValues + kAbsoluteValues] = {};
    for (; from < stop; from += in.values)
      for (int v = 0; v < in.values; ++v) sums[v] += from[v];
    std::copy_n(sums, in.values, to);
  });
}

template void sum_runs<float>(const Executor&, const SumInput<float>&);
template void sum_runs<double>(const Executor&, const SumInput<double>&);

}  // namespace gs
