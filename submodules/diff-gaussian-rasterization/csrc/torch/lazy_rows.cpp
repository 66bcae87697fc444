// The ops that let rows of SH coefficients take the steps that they lack.
#include "lazy_rows.h"

#include "scene.h"

namespace gs::ops {

namespace {

// sh_dc and sh_rest, with Adam's averages of both.
struct LazyTensors {
  const Tensor &dc, &rest;
  at::TensorList exp_avg, exp_avg_sq;
  at::IntArrayRef columns;
  const Tensor &last, &ring, &taken;

  template <class T>
  gs::CatchUp<T> catch_up(bool all) const {
    for (size_t size : {exp_avg.size(), exp_avg_sq.size(), columns.size()})
      TORCH_CHECK_VALUE(size == gs::kLazy, "every list must have an entry for sh_dc and sh_rest, got ", size);
    gs::CatchUp<T> out{};
    const Tensor* const values[] = {&dc, &rest};
    for (int a = 0; a < gs::kLazy; ++a) {
      check_moments(*values[a], *values[a], exp_avg[a], exp_avg_sq[a]);
      out.attributes[a] = adam_input<T>(*values[a], *values[a], exp_avg[a], exp_avg_sq[a], columns[a]);
    }
    TORCH_CHECK_VALUE(
        rows_of(dc) == rows_of(rest) && dc.scalar_type() == rest.scalar_type() && dc.device() == rest.device(),
        "sh_dc and sh_rest must have the same rows, dtype and device");
    out.rows = lazy_rows<T>(rows_of(dc), dc, last, ring, taken);
    out.all = all;
    return out;
  }
};

// All rows take the steps that they lack.
void catch_up_op(Tensor& sh_dc, Tensor& sh_rest, at::TensorList exp_avg, at::TensorList exp_avg_sq,
                 at::IntArrayRef columns, Tensor& last, const Tensor& ring, const Tensor& taken) {
  for (const auto& [name, t] : {std::pair("sh_dc", &sh_dc), std::pair("sh_rest", &sh_rest)}) check_given(*t, name);
  const LazyTensors in{sh_dc, sh_rest, exp_avg, exp_avg_sq, columns, last, ring, taken};
  with_scalar(sh_dc.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    gs::Scene<T> scene{};
    scene.count = rows_of(sh_dc);
    GS_RUN(T, sh_dc, catch_up, scene, in.catch_up<T>(true));
  });
}

// The rows that the view may see take the steps that they lack.
void catch_up_seen_op(SCENE_PARAMETERS, at::TensorList exp_avg, at::TensorList exp_avg_sq, at::IntArrayRef columns,
                      const Tensor& last, const Tensor& ring, const Tensor& taken) {
  const SceneTensors scene(SCENE_ARGUMENTS);
  TORCH_CHECK_VALUE(!cov3d && !colors, "steps need scales, rotations, sh_dc and sh_rest, not cov3d or colors");
  const LazyTensors in{*sh_dc, *sh_rest, exp_avg, exp_avg_sq, columns, last, ring, taken};
  with_scalar(scene.dtype(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, means, catch_up, scene.scene<T>(), in.catch_up<T>(false));
  });
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(diff_gaussian_rasterization, m) {
  const std::string lists =
      "exp_avg, Tensor(d!)[] exp_avg_sq, int[] columns, Tensor(e!) last, Tensor ring, Tensor taken) -> ()";
  define(m, "catch_up_(Tensor(a!) sh_dc, Tensor(b!) sh_rest, Tensor(c!)[] " + lists, &catch_up_op);
  std::string scene = SCENE_SCHEMA;
  for (const auto& [name, alias] : {std::pair("? sh_dc", "(a!)"), std::pair("? sh_rest", "(b!)")})
    scene.insert(scene.find(name), alias);
  define(m, "catch_up_seen_(" + scene + ", Tensor(c!)[] " + lists, &catch_up_seen_op);
}

}  // namespace gs::ops
