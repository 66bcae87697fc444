#pragma once
// Activations, from the optimised parameters (log scale, logit, free quaternion) to the rendered ones, with
// derivatives.
#include "constants.h"
#include "exponential.h"
#include "vec.h"

GS_ISA_BEGIN

// log2 of the logistic function sigmoid(x) = 1/(1+e^-x), accurate for any logit.
template <class T>
GS_HD T log2_sigmoid(T logit) {
  const T away = log_one_plus(exponential(-magnitude(logit)));
  return (logit > 0 ? -away : logit - away) * Scalar<T>(1.44269504088896340736);
}

// d ln sigmoid(x) / dx = sigmoid(-x).
template <class T>
GS_HD T log_sigmoid_slope(T logit) {
  const T e = exponential(-magnitude(logit));
  return (logit > 0 ? e : all<T>(1)) / (1 + e);
}

template <class T>
struct Quat {
  T w, x, y, z;
};

// q / |q|; a quaternion shorter than 1e-30 counts as the identity. Gives normalise_vjp its `norm`, which is 0 for such
// a quaternion.
template <class T>
GS_HD Quat<T> normalise(Quat<T> q, T& norm) {
  // Divides by the largest entry first: squares of 1e-20 and 1e20 leave the range of float.
  const T m = larger(larger(magnitude(q.w), magnitude(q.x)), larger(magnitude(q.y), magnitude(q.z)));
  const Truth<T> none = m < Scalar<T>(kMinQuaternion);
  const Quat<T> s = {q.w / m, q.x / m, q.y / m, q.z / m};
  const T r = root(s.w * s.w + s.x * s.x + s.y * s.y + s.z * s.z), zero = {};
  norm = none ? zero : m * r;
  return {none ? all<T>(1) : s.w / r, none ? zero : s.x / r, none ? zero : s.y / r, none ? zero : s.z / r};
}

// The gradient of q from the torque about the rotation's own axes: small angles a about them turn n = q / |q| into
// n (1, a/2).
template <class T>
GS_HD Quat<T> normalise_vjp(Quat<T> n, T norm, Vec3<T> torque) {
  const Truth<T> some = norm > 0;
  const T k = 2 / norm, zero = {};
  const Vec3<T> t = torque;
  return {some ? k * (-n.x * t.x - n.y * t.y - n.z * t.z) : zero, some ? k * (n.w * t.x + n.y * t.z - n.z * t.y) : zero,
          some ? k * (n.w * t.y + n.z * t.x - n.x * t.z) : zero, some ? k * (n.w * t.z + n.x * t.y - n.y * t.x) : zero};
}

GS_ISA_END
