#include "scene.h"

#include <cmath>
#include <iterator>
#include <limits>
#include <string>
#include <utility>

#include "math/lens_pixels.h"
#include "math/sh.h"
#include "math/tiles.h"

namespace gs::ops {

namespace {

using namespace gs::baseline;

constexpr int64_t kMostRestBands = sh_count(kMaxShDegree) - 1;

// A Gaussian's part of each input: values, or bands of values. sh_rest has any number of bands.
struct Row {
  const char* name;
  int64_t values, bands;
};
constexpr int64_t kNoBands = 0, kAnyBands = -1;
constexpr Row kRows[] = {
    {"means2d", 3, kNoBands},   {"means", 3, kNoBands}, {"opacities", 1, kNoBands}, {"scales", 3, kNoBands},
    {"rotations", 4, kNoBands}, {"cov3d", 6, kNoBands}, {"colors", 3, kNoBands},    {"sh_dc", 3, 1},
    {"sh_rest", 3, kAnyBands}};
static_assert(std::size(kRows) == kInputs, "every input has a row");

Shape sizes_of(const Row& row, int64_t count, int64_t rest_bands) {
  if (row.bands == kNoBands) return {count, row.values};
  return {count, row.bands == kAnyBands ? rest_bands : row.bands, row.values};
}

// Rows may lie apart, so that a slice of more bands needs no copy.
Tensor with_whole_rows(const Tensor& t) {
  const bool whole = t.size(1) == 0 || (t.stride(2) == 1 && t.stride(1) == t.size(2));
  return whole ? t : packed(t);
}

}  // namespace

gs::Image checked_image(int64_t height, int64_t width) {
  GS_CHECK(height > 0 && width > 0 && height < (1 << 24) && width < (1 << 24), "image size ", width, "x", height,
           " is out of range");
  const gs::Image image{int(width), int(height)};
  GS_CHECK(tiles_of(image) <= std::numeric_limits<int32_t>::max(), "image size ", width, "x", height,
           " has more than 2^31 - 1 tiles of ", kTile, "x", kTile);
  return image;
}

SceneTensors::SceneTensors(const std::array<const Tensor*, kInputs - 1>& gaussians,
                           const std::array<const Tensor*, 3>& camera, List<double> lens, Sizes options)
    : dtype_(ScalarType::Float), device_(DeviceType::CPU) {
  const bool plain = lens.size() < 3 + gs::kLensNumbers;
  const int64_t further = int64_t(lens.size()) - 3 - (plain ? 0 : gs::kLensNumbers);
  GS_CHECK_VALUE((further == 0 || further == 2) && (options.size() == 5 || options.size() == 6),
                 "lens must have 3, 5, 25 or 27 entries, and options 5 or 6, got ", lens.size(), " and ",
                 options.size());
  if (further) dilation_ = lens[lens.size() - 2], near_ = lens[lens.size() - 1];
  tan_x_ = lens[0], tan_y_ = lens[1], scale_modifier_ = lens[2];
  for (int k = 0; !plain && k < gs::kLensNumbers; ++k) lens_[k] = lens[3 + k];
  image_ = checked_image(options[0], options[1]);
  GS_CHECK_VALUE(options[2] >= 0 && options[2] <= kMaxShDegree, "sh_degree must be 0 to 3, got ", options[2]);
  sh_degree_ = int(options[2]), antialiasing_ = int(options[3]);
  raw_ = options[4] == 1, any_rotation_ = options[4] != 0, keeps_shapes_ = options[4] == 2;
  rays_ = options.size() > 5 && options[5];
  const auto has = [&](Input input) { return gaussians[input - 1] != nullptr; };
  GS_CHECK_TYPE(has(kMeans) && gaussians[0]->defined(), "means must be a tensor, got None");
  const Tensor& means = *gaussians[0];
  dtype_ = means.scalar_type(), device_ = means.device();
  GS_CHECK_TYPE(is_floating(dtype_), "means must be float32 or float64, got ", dtype_);
  GS_CHECK_VALUE(means.dim() == 2 && means.size(1) == 3, "means must be (N, 3), got ", means.sizes());
  GS_CHECK_VALUE(has(kCov3d) != (has(kScales) && has(kRotations)), "give scales and rotations, or cov3d");
  GS_CHECK_VALUE(has(kColors) != (has(kShDc) && has(kShRest)), "give sh_dc and sh_rest, or colors");
  inputs_[kMeans] = packed(means);
  for (int input = kOpacities; input < kInputs; ++input) inputs_[input] = checked(Input(input), gaussians[input - 1]);
  check_precise(*camera[0], "view", {4, 4});
  check_precise(*camera[1], "projection", {4, 4});
  check_precise(*camera[2], "center", {3});
  view_ = converted(*camera[0], means), projection_ = converted(*camera[1], means);
  center_ = converted(*camera[2], means);
  check_settings();
}

void SceneTensors::set_awake(const Tensor* awake) {
  if (!awake) return;
  if (has_dtype(*awake, ScalarType::Int) && device_.is_cuda()) {
    check_tensor(*awake, "awake", ScalarType::Int, device_, {-1});
    GS_CHECK_VALUE(awake->size(0) || !count(), "a list of the blocks that are awake needs an entry");
    blocks_ = packed(*awake);
    return;
  }
  check_tensor(*awake, "awake", ScalarType::Byte, device_, {gs::sleep_blocks(count())});
  awake_ = packed(*awake);
}

Tensor SceneTensors::checked(Input input, const Tensor* given) const {
  const Row& row = kRows[input];
  const bool none = !given || !given->defined();
  GS_CHECK_TYPE(!none || input != kOpacities, row.name, " must be a tensor, got None");
  if (none) return {};
  const Tensor& t = *given;
  GS_CHECK_TYPE(has_dtype(t, dtype_) && t.device() == device_, row.name, " must be ", dtype(), " on ", device(),
                " like means, got ", t.scalar_type(), " on ", t.device());
  if (input == kShRest) return checked_rest(t);
  const Shape wanted = sizes_of(row, count(), 0);
  const bool flat = input == kOpacities && t.dim() == 1 && t.size(0) == count();
  const char* hint = input != kScales ? "" : raw_ ? " (logarithms of the scales)" : " (activated scales, one per axis)";
  GS_CHECK_VALUE(same(t.sizes(), wanted) || flat, row.name, " must be ", wanted, hint, ", got ", t.sizes());
  return row.bands == kNoBands ? packed(t) : with_whole_rows(t);
}

Tensor SceneTensors::checked_rest(const Tensor& t) const {
  const int64_t needed = sh_count(sh_degree_) - 1;
  const bool fits = t.dim() == 3 && t.size(0) == count() && t.size(1) >= needed && t.size(2) == 3;
  GS_CHECK_VALUE(fits, "sh_rest must be (", count(), ", ", needed, " or more, 3) for sh_degree ", sh_degree_, ", got ",
                 t.sizes());
  GS_CHECK(t.size(1) <= kMostRestBands, "sh_rest has ", t.size(1), " bands, more than the ", kMostRestBands,
           " of degree 3");
  return with_whole_rows(t);
}

void SceneTensors::check_settings() const {
  for (const auto& [name, tan] : {std::pair("tan_x", tan_x_), std::pair("tan_y", tan_y_)})
    GS_CHECK_VALUE(tan >= 0 && std::isfinite(tan), name, " must be the tangent of half an angle of view, got ", tan);
  GS_CHECK_VALUE(lens_[0] >= 0 && lens_[0] <= 3 && lens_[0] == int(lens_[0]), "a lens's chart is 1, 2 or 3, got ",
                 lens_[0]);
  for (const double number : lens_) GS_CHECK_VALUE(!std::isnan(number), "a lens has a number that is NaN");
  GS_CHECK_VALUE(dilation_ >= 0 && dilation_ <= 1, "the dilation must be 0 to 1 px^2, got ", dilation_);
  GS_CHECK_VALUE(near_ >= 0 && std::isfinite(near_), "the near plane must be 0 or more, got ", near_);
  GS_CHECK_VALUE(std::isfinite(scale_modifier_), "scale_modifier must be finite, got ", scale_modifier_);
  GS_CHECK(count() < std::numeric_limits<int32_t>::max(), "more than 2^31 Gaussians");
}

Tensor table_of(const double* numbers, gs::Image image, const Tensor& like) {
  Tensor table = empty({lens_table_values(image)}, like);
  with_scalar(like.scalar_type(), [&](auto zero) {
    using T = decltype(zero);
    GS_RUN(T, table, lens_table, lens_from<double>(numbers), image, write<T>(table));
  });
  return table;
}

Tensor SceneTensors::table() const {
  return rays() == gs::kLensRays ? table_of(lens_.data(), image_, means()) : Tensor();
}

Wanted checked_wanted(const std::vector<bool>& wanted) {
  Wanted out{};
  GS_CHECK_VALUE(wanted.size() == out.size(), "wanted must have ", out.size(), " entries, got ", wanted.size());
  std::copy(wanted.begin(), wanted.end(), out.begin());
  return out;
}

SceneGradients::SceneGradients(const SceneTensors& in, const Wanted& wanted) : wanted_(wanted) {
  for (int input = 0; input < kInputs; ++input) {
    const bool flat = input == kOpacities && wanted[input] && in.flat_opacities();
    tensors_[input] = empty(
        flat ? Shape{in.count()} : sizes_of(kRows[input], wanted[input] ? in.count() : 0, in.rest_bands()), in.means());
  }
}

}  // namespace gs::ops
