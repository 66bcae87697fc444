#pragma once
// The camera: from the world to its view, and the constants of perspective.
#include "constants.h"
#include "vec.h"

GS_ISA_BEGIN

// Pinhole camera, x right, y down, z forward; pixel centres at integers.
template <class T>
struct Camera {
  Vec3<T> row_x, row_y, row_z;     // world-to-view, without the translation; of a rotation, or of any other matrix
  Vec3<T> dual_x, dual_y, dual_z;  // cross products of the other two rows in turn; for a rotation, the rows
  Vec3<T> translation;             // world-to-view
  Vec3<T> center;                  // in the world
  T focal_x, focal_y;              // px, in the covariance's Jacobian
  T mean_focal_x, mean_focal_y;    // px, for the mean; as above unless the caller's matrices disagree
  T axis_x, axis_y;                // px, where the optical axis meets the image
  T ray_min_x, ray_max_x;          // limits of x/z in the Jacobian
  T ray_min_y, ray_max_y;
  int width, height;
  T near;
};

// Whether two vectors agree within the rounding of a cross product of unit vectors.
template <class T>
GS_HD bool agree(Vec3<T> a, Vec3<T> b) {
  constexpr T most = T(sizeof(T) == sizeof(float) ? 0x1p-21 : 0x1p-50);  // 4 units in the last place of 1
  return magnitude(a.x - b.x) < most && magnitude(a.y - b.y) < most && magnitude(a.z - b.z) < most;
}

// shift: of the principal point, in half images. tan: of half the field of view.
template <class T>
GS_HD void clamp_rays(double shift_x, double shift_y, double tan_x, double tan_y, Camera<T>& cam) {
  const double limit = kJacobianClamp;
  cam.ray_min_x = T((-limit - shift_x) * tan_x), cam.ray_max_x = T((limit - shift_x) * tan_x);
  cam.ray_min_y = T((-limit - shift_y) * tan_y), cam.ray_max_y = T((limit - shift_y) * tan_y);
}

// Makes a camera from the reference's settings: the view and the full projection matrix, both transposed (for row
// vectors), row-major. Dot products with the dual rows extract the projection's own entries from the full matrix. They
// are computed in double, without the part from x . z, which is 0 up to rounding: in a narrow field of view the scale
// is 1e5 times the shift. A tangent of 0 stands for the projection's own.
template <class T>
GS_HD Camera<T> make_camera(const T* view, const T* full, const T* center, double tan_x, double tan_y, int width,
                            int height, T near) {
  const auto column = [](const T* m, int c) { return Vec3<T>{m[c], m[4 + c], m[8 + c]}; };
  const auto wide = [](Vec3<T> v) { return Vec3<double>{v.x, v.y, v.z}; };
  Camera<T> cam;
  cam.row_x = column(view, 0), cam.row_y = column(view, 1), cam.row_z = column(view, 2);
  cam.translation = {view[12], view[13], view[14]};
  cam.center = load3(center);
  cam.width = width, cam.height = height, cam.near = near;
  cam.focal_x = T(width / (2 * tan_x)), cam.focal_y = T(height / (2 * tan_y));
  cam.dual_x = cross(cam.row_y, cam.row_z), cam.dual_y = cross(cam.row_z, cam.row_x);
  cam.dual_z = cross(cam.row_x, cam.row_y);
  const bool rotation = agree(cam.dual_x, cam.row_x) && agree(cam.dual_y, cam.row_y) && agree(cam.dual_z, cam.row_z);
  if (rotation) cam.dual_x = cam.row_x, cam.dual_y = cam.row_y, cam.dual_z = cam.row_z;
  const Vec3<double> x = wide(cam.row_x), y = wide(cam.row_y);
  const Vec3<double> dual_x = wide(cam.dual_x), dual_y = wide(cam.dual_y), dual_z = wide(cam.dual_z);
  const Vec3<double> clip_x = wide(column(full, 0)), clip_y = wide(column(full, 1));
  const T one = 1;  // over the determinant, from the products of each row and its dual
  const double per_x = rotation ? one : one / dot(cam.row_x, cam.dual_x);
  const double per_y = rotation ? one : one / dot(cam.row_y, cam.dual_y);
  const double per_z = rotation ? one : one / dot(cam.row_z, cam.dual_z);
  const double scale_x = per_x * dot(clip_x, dual_x), scale_y = per_y * dot(clip_y, dual_y);
  const double shift_x = per_z * (dot(clip_x, dual_z) - scale_x * dot(x, dual_z));
  const double shift_y = per_z * (dot(clip_y, dual_z) - scale_y * dot(y, dual_z));
  cam.mean_focal_x = T(0.5 * width * scale_x), cam.mean_focal_y = T(0.5 * height * scale_y);
  cam.axis_x = T(0.5 * (width * (1 + shift_x) - 1)), cam.axis_y = T(0.5 * (height * (1 + shift_y) - 1));
  if (tan_x == 0) cam.focal_x = magnitude(cam.mean_focal_x), tan_x = T(0.5) * width / cam.focal_x;
  if (tan_y == 0) cam.focal_y = magnitude(cam.mean_focal_y), tan_y = T(0.5) * height / cam.focal_y;
  clamp_rays(shift_x, shift_y, tan_x, tan_y, cam);
  return cam;
}

template <class T, class V>
GS_HD Vec3<V> to_view(const Camera<T>& cam, Vec3<V> p) {
  return Vec3<V>{dot(cam.row_x, p), dot(cam.row_y, p), dot(cam.row_z, p)} + cam.translation;
}

// The near rule of the reference; false for NaN.
template <class T, class V>
GS_HD Truth<V> in_front(const Camera<T>& cam, V view_z) {
  return view_z > cam.near;
}

GS_ISA_END
