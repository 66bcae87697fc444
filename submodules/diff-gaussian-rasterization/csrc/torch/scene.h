#pragma once
// The Gaussians and the camera as tensors, and their gradients. A new input is added to GRADIENTS_SCHEMA, to Input, to
// the table of rows and the constructor in scene.cpp, and to the structs of data.h.
#include <array>
#include <tuple>
#include <utility>

#include "tensors.h"

// The Gaussians, of which some may be null; the view matrix and the full projection, both transposed, and the centre;
// tan_x, tan_y and scale_modifier, perhaps the numbers of a gs::Lens, and perhaps dilation and near; height, width,
// sh_degree, antialiasing (2: without a floor), raw (2: rotations alone have any length, and shapes are kept), and
// perhaps whether Gaussians are seen on rays.
#define CAMERA_SCHEMA "float[] lens, int[] options"
#define SCENE_SCHEMA                                                                                   \
  "Tensor means, Tensor opacities, Tensor? scales, Tensor? rotations, Tensor? cov3d, Tensor? colors, " \
  "Tensor? sh_dc, Tensor? sh_rest, Tensor view, Tensor projection, Tensor center, " CAMERA_SCHEMA
#define SCENE_PARAMETERS                                                                                         \
  const Tensor &means, const Tensor &opacities, const MaybeTensor &scales, const MaybeTensor &rotations,         \
      const MaybeTensor &cov3d, const MaybeTensor &colors, const MaybeTensor &sh_dc, const MaybeTensor &sh_rest, \
      const Tensor &view, const Tensor &projection, const Tensor &center, List<double> lens, Sizes options
#define SCENE_ARGUMENTS                                                                                             \
  {&means, &opacities, given(scales), given(rotations), given(cov3d), given(colors), given(sh_dc), given(sh_rest)}, \
      {&view, &projection, &center}, lens, options
#define GRADIENTS_SCHEMA                                                                             \
  "(Tensor means2d, Tensor means, Tensor opacities, Tensor scales, Tensor rotations, Tensor cov3d, " \
  "Tensor colors, Tensor sh_dc, Tensor sh_rest)"

namespace gs::ops {

// Checks the size of an image and of its tiles.
gs::Image checked_image(int64_t height, int64_t width);

// The inputs that have a gradient, in the order of GRADIENTS_SCHEMA. means2d has nothing else: its values are not read.
enum Input { kMeans2d, kMeans, kOpacities, kScales, kRotations, kCov3d, kColors, kShDc, kShRest, kInputs };

using InputTensors = std::array<Tensor, kInputs>;
using Gradients = decltype(std::tuple_cat(std::declval<InputTensors>()));
using Wanted = std::array<bool, kInputs>;

// The same from a list that a caller gave.
Wanted checked_wanted(const std::vector<bool>& wanted);

// Null for none; Python's None for an argument that must be a tensor is an undefined one.
inline const Tensor* given(const Tensor& t) { return t.defined() ? &t : nullptr; }
inline const Tensor* given(const MaybeTensor& t) { return t ? given(*t) : nullptr; }

// A lens from its numbers.
template <class T>
gs::Lens<T> lens_from(const double* n) {
  const auto at = [&](int k) { return T(n[k]); };
  return {gs::Chart(int(n[0])),
          at(1),
          at(2),
          at(3),
          at(4),
          at(5),
          at(6),
          at(7),
          at(8),
          at(9),
          at(10),
          {at(11), at(12), at(13), at(14)},
          {at(15), at(16), at(17)},
          {at(18), at(19)},
          {at(20), at(21)}};
}

// gs::Projected::table of a lens, by its numbers, like `like`.
Tensor table_of(const double* numbers, gs::Image image, const Tensor& like);

// Checks the inputs, and owns the contiguous tensors that a gs::Scene points into.
class SceneTensors {
 public:
  // gaussians: those of Input, in its order, without means2d; null for none. camera: view matrix, projection and
  // centre.
  SceneTensors(const std::array<const Tensor*, kInputs - 1>& gaussians, const std::array<const Tensor*, 3>& camera,
               List<double> lens, Sizes options);

  // Takes which blocks sleep (gs::Scene::awake), or on a GPU which do not (gs::Scene::blocks), if that is given.
  void set_awake(const Tensor* awake);

  // Checks the shape, dtype and device of an input. Returns it contiguous; undefined where it was not given.
  Tensor checked(Input input, const Tensor* given) const;

  bool has(Input input) const { return inputs_[input].defined(); }
  bool raw() const { return raw_; }
  bool has_lens() const { return lens_[0] != 0; }
  gs::Rays rays() const { return !rays_ ? gs::kNoRays : has_lens() ? gs::kLensRays : gs::kPinholeRays; }
  // gs::Projected::table; undefined where there is none.
  Tensor table() const;
  bool flat_opacities() const { return inputs_[kOpacities].dim() == 1; }  // a row instead of a column
  const Tensor& means() const { return inputs_[kMeans]; }
  int64_t count() const { return inputs_[kMeans].size(0); }
  const Tensor& blocks() const { return blocks_; }
  // Rows of what is made of the Gaussians (gs::Scene::rows).
  int64_t rows() const { return blocks_.defined() ? blocks_.size(0) * gs::kSleepBlock : count(); }
  gs::Image image() const { return image_; }
  ScalarType dtype() const { return dtype_; }
  Device device() const { return device_; }
  int64_t rest_bands() const { return inputs_[kShRest].defined() ? inputs_[kShRest].size(1) : 0; }

  template <class T>
  gs::Scene<T> scene() const {
    const auto pointer = [](const Tensor& t) { return t.defined() ? read<T>(t) : nullptr; };
    const auto stride = [](const Tensor& t) { return t.defined() ? t.stride(0) : 0; };
    return {count(),
            pointer(inputs_[kMeans]),
            pointer(inputs_[kOpacities]),
            pointer(inputs_[kScales]),
            pointer(inputs_[kRotations]),
            pointer(inputs_[kCov3d]),
            pointer(inputs_[kColors]),
            pointer(inputs_[kShDc]),
            pointer(inputs_[kShRest]),
            stride(inputs_[kShDc]),
            stride(inputs_[kShRest]),
            int(rest_bands()),
            sh_degree_,
            raw_,
            antialiasing_ != 0,
            T(scale_modifier_),
            pointer(view_),
            pointer(projection_),
            pointer(center_),
            tan_x_,
            tan_y_,
            image_,
            awake_.defined() ? read<uint8_t>(awake_) : nullptr,
            blocks_.defined() ? read<int32_t>(blocks_) : nullptr,
            blocks_.defined() ? blocks_.size(0) : 0,
            lens_from<T>(lens_.data()),
            rays_,
            gs::dilation_of<T>(dilation_, antialiasing_ == 2 ? 0 : gs::kUsualFloor),
            T(near_),
            any_rotation_,
            keeps_shapes_};
  }

 private:
  Tensor checked_rest(const Tensor& t) const;
  void check_settings() const;

  ScalarType dtype_;
  Device device_;
  InputTensors inputs_;  // means2d stays undefined
  Tensor view_, projection_, center_, awake_, blocks_;
  double tan_x_, tan_y_, scale_modifier_, dilation_ = gs::kUsualDilation, near_ = gs::kUsualNear;
  std::array<double, gs::kLensNumbers> lens_ = {};  // gs::Lens; a pinhole if it is not given
  int sh_degree_, antialiasing_;
  bool raw_, any_rotation_, keeps_shapes_, rays_;
  gs::Image image_;
};

// Owns the gradients of the inputs; those not wanted have no rows.
class SceneGradients {
 public:
  SceneGradients(const SceneTensors& in, const Wanted& wanted);

  template <class T>
  gs::SceneGradient<T> pointers() const {
    const auto of = [this](Input input) { return wanted_[input] ? write<T>(tensors_[input]) : nullptr; };
    return {of(kMeans), of(kMeans2d), of(kOpacities), of(kScales), of(kRotations),
            of(kCov3d), of(kColors),  of(kShDc),      of(kShRest)};
  }
  Gradients all() const { return std::tuple_cat(tensors_); }

 private:
  Wanted wanted_;
  InputTensors tensors_;
};

}  // namespace gs::ops
