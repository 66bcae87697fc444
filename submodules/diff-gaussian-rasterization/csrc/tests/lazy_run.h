#pragma once
// Rows that wait for their steps beside rows that take every step: after they have caught up, both must have the same
// bits.
#include <algorithm>

#include "math/lazy_rows.h"
#include "step_run.h"

// What is known of rows that wait; at first none does.
template <class T>
struct Waiting {
  std::vector<int32_t> last;
  std::vector<T> ring = std::vector<T>(gs::kLazySteps * gs::kLazy * gs::kLazyConstants, T(NAN));
  int32_t taken = 0;

  explicit Waiting(int64_t count) : last(count, gs::kEveryStep) {}
  gs::LazyRows<T> rows() { return {last.data(), ring.data(), &taken}; }
};

// A place from which the Gaussians of scene_of are seen: the camera stands `right` of the origin.
struct Place {
  float view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}, center[3] = {0, 0, 0};
  explicit Place(float right) { view[12] = -right, center[0] = right; }
  gs::Scene<float> scene(Parameters<float>& values) const {
    gs::Scene<float> s = scene_of(values, {40, 24}, false);
    s.view = view, s.center = center;
    return s;
  }
};

inline gs::CatchUp<float> catch_up_of(const gs::GaussianStep<float>& step, Waiting<float>& waiting, bool all) {
  gs::CatchUp<float> in{waiting.rows(), {}, all};
  std::copy_n(step.attributes + gs::kFirstLazy, gs::kLazy, in.attributes);
  return in;
}

// Rows at the edge of what may wait: zero averages beside -0, a mean of -0, averages that are too large.
inline void add_edges(Stepping& s) {
  if (s.values.count < 40) return;
  for (int a : {gs::kStepShDc, gs::kStepShRest}) {
    const int row = a == gs::kStepShDc ? 3 : 45;
    std::fill_n(&s.mean[a][7 * row], row, 0.0f), std::fill_n(&s.square[a][7 * row], row, 0.0f);
    (*s.values.all()[a])[7 * row] = -0.0f;
    std::fill_n(&s.mean[a][8 * row], row, -0.0f);
    s.mean[a][9 * row + 1] = 1e20f, s.square[a][9 * row + 1] = 0;
    (*s.values.all()[a])[10 * row + 2] = 3e37f;
  }
}

// Some steps from several places. step(scene, rendered, step) runs a backward with the Gaussians' steps.
template <class Where, class Step>
void check_lazy_steps(const Where& where, int64_t count, const StepCase& how, int lost_at, const Step& take_step) {
  using gs::cuda::catch_up, gs::GS_ISA::catch_up;
  Stepping dense{Parameters<float>(count)};
  add_edges(dense);
  Stepping lazy = dense;
  Waiting<float> waiting(count);
  bool waited = false;
  const float places[] = {0, -4, 4, 100, 0, 3, -4, 100, 4};
  for (int number = 1; number <= 9; ++number) {
    const Place place(places[number - 1]);
    const float gradient = number == 5 ? how.gradient : 1;
    std::vector<float> images[2];
    for (Stepping* s : {&dense, &lazy}) {
      s->loss = number == lost_at ? NAN : 0.5f;
      const gs::Scene<float> scene = place.scene(s->values);
      const bool late = s == &lazy;
      gs::CatchUp<float> rows = catch_up_of(gaussian_step(*s, how, Rendered{}, number, number), waiting, false);
      for (int twice = 0; twice < 2 && late; ++twice) catch_up(where, scene, rows);
      const auto r = render(where, scene, gradient);
      gs::GaussianStep<float> step = gaussian_step(*s, how, *r, number, number);
      if (late) step.lazy = waiting.rows(), step.number = number;
      take_step(*r, step);
      waited |= late && std::any_of(waiting.last.begin(), waiting.last.end(),
                                    [&](int32_t last) { return last >= 0 && last < waiting.taken; });
      rows.all = true;
      if (late && number % 4 == 3) catch_up(where, scene, rows);
      images[late] = r->color;
    }
    CHECK(images[0] == images[1]);
    CHECK(number % 4 != 3 || dense.bytes() == lazy.bytes());
  }
  gs::CatchUp<float> rows = catch_up_of(gaussian_step(lazy, how, Rendered{}, 9, 9), waiting, true);
  catch_up(where, Place(0).scene(lazy.values), rows);
  CHECK(dense.bytes() == lazy.bytes());
  CHECK(waited || count <= 1);
  const bool stops = how.guarded && (std::isnan(how.gradient) || lost_at);
  CHECK(waiting.taken == (!stops ? 9 : lost_at ? lost_at - 1 : 5) || count <= 1);
}

template <class Where, class Step>
void check_lazy_steps(const Where& where, const Step& take_step) {
  for (const int64_t count : {0, 1, 33, 200})
    for (const StepCase& how : kStepCases)
      if (!how.sparse) check_lazy_steps(where, count, how, 0, take_step);
  check_lazy_steps(where, 200, {false, true}, 6, take_step);
}

// Any number of late steps, whose constants differ, against as many steps of a gradient of zero.
template <class T, class Where>
void check_late_steps(const Where& where) {
  using gs::cuda::adam, gs::GS_ISA::adam, gs::cuda::catch_up, gs::GS_ISA::catch_up;
  constexpr int64_t kRows = 70, kRow[] = {3, 45};
  for (const int late : {0, 1, 2, 17, 255}) {
    Waiting<T> waiting(kRows);
    std::vector<T> got[2][3], wanted[2][3], zeros(kRows * 45);
    gs::CatchUp<T> rows{waiting.rows(), {}, true};
    gs::AdamInput<T> dense[2];
    for (int a = 0; a < 2; ++a) {
      for (int64_t k = 0; k < kRows * kRow[a]; ++k) {
        const double size = std::exp(8 * normal());
        got[a][0].push_back(T(normal())), got[a][1].push_back(T(size * normal() * 1e-4));
        got[a][2].push_back(T(size * size * 1e-8));
      }
      for (int part = 0; part < 3; ++part) wanted[a][part] = got[a][part];
      const auto input = [&](std::vector<T>* v) {
        return gs::AdamInput<T>{
            v[0].data(), zeros.data(), v[1].data(), v[2].data(), kRows, kRow[a], kRow[a] - 2 * a, 0, 0, 0, 0, 0};
      };
      rows.attributes[a] = input(got[a]), dense[a] = input(wanted[a]);
    }
    std::fill(waiting.last.begin(), waiting.last.end(), 300), waiting.taken = 300 + late;
    for (int number = 301; number <= 300 + late; ++number) {
      for (int a = 0; a < 2; ++a) {
        gs::AdamInput<T>& in = dense[a];
        in.lr = 0.01 * (a + 1 + number % 3), in.beta1 = 0.9, in.beta2 = 0.999, in.eps = 1e-15, in.step = number - 290;
        store_step(make_adam_step<T>(in.lr, in.beta1, in.beta2, in.eps, in.step),
                   waiting.ring.data() + ring_place(number, a));
      }
      adam(where, dense, 2, gs::StepGuard<T>{});
    }
    gs::Scene<T> scene{};
    scene.count = kRows;
    catch_up(where, scene, rows);
    for (int a = 0; a < 2; ++a)
      for (int part = 0; part < 3; ++part) CHECK(got[a][part] == wanted[a][part]);
    for (const int32_t last : waiting.last) CHECK(last == 300 + late);
  }
}
