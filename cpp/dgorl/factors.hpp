// The factors: each gives its normalised residual (e / sigma, or U e with U'U = information) and, on request,
// the Jacobians with respect to the right perturbations of its two poses. METHOD sections 1 and 2.
#pragma once

#include <Eigen/Core>
#include <algorithm>

#include "dgorl/se2.hpp"

namespace dgorl {

template <int Dim>
struct Jacobians {
  Eigen::Matrix<double, Dim, 3> i, j;
};

// e = vec(delta^-1 (X_i B_i)^-1 (X_j B_j)). With Z = B_i delta it equals, up to the constant rotation of Z
// that `root` absorbs, (R_i'(p_j + R_j t_Bj - p_i) - t_Z, theta_j + theta_Bj - theta_i - theta_Z).
struct RelativePose {
  static constexpr int kDim = 3;
  static constexpr const char* kName = "relative_pose";
  Vector2 at_j, target;
  double angle;
  Matrix3 root;

  RelativePose(const Pose& T_i_at, const Pose& T_j_at, const Pose& delta, const Matrix3& upper_root);

  Vector3 operator()(const Pose& x_i, const Pose& x_j, Jacobians<3>* jac) const {
    const Vector2 arm_j = x_j.rotate(at_j);
    const Vector2 v = x_i.unrotate(x_j.position() + arm_j - x_i.position());
    const Vector2 t = v - target;
    if (jac) {
      const double c = x_i.c * x_j.c + x_i.s * x_j.s, s = x_i.c * x_j.s - x_i.s * x_j.c;  // of R_i'R_j
      const Vector2 turn_j = x_i.unrotate(quarter_turn(arm_j));
      jac->i.col(0) = -root.col(0);
      jac->i.col(1) = -root.col(1);
      jac->i.col(2) = root.col(0) * v.y() - root.col(1) * v.x() - root.col(2);
      jac->j.col(0) = root.col(0) * c + root.col(1) * s;
      jac->j.col(1) = root.col(1) * c - root.col(0) * s;
      jac->j.col(2) = root.col(0) * turn_j.x() + root.col(1) * turn_j.y() + root.col(2);
    }
    return root.col(0) * t.x() + root.col(1) * t.y() + root.col(2) * wrap(x_j.theta - x_i.theta - angle);
  }
};

using Scalar = Eigen::Matrix<double, 1, 1>;

// Shared by all factors of the distance between two points: `slope` is de/da, a on body i and b on body j.
inline void point_pair_jacobians(const Pose& x_i, const Pose& x_j, const Vector2& arm_i, const Vector2& arm_j,
                                 const Vector2& slope, Jacobians<1>* jac) {
  const Vector2 in_i = x_i.unrotate(slope), in_j = x_j.unrotate(slope);
  jac->i << in_i.x(), in_i.y(), slope.dot(quarter_turn(arm_i));
  jac->j << -in_j.x(), -in_j.y(), -slope.dot(quarter_turn(arm_j));
}

// Metric range: e = (d - r) / sigma, d the slant distance between two antennas.
struct Range {
  static constexpr int kDim = 1;
  static constexpr const char* kName = "range";
  static constexpr double kNearest = 1e-3;  // [m] the gradient stays bounded where the antennas meet
  Vector2 at_i, at_j;
  double height_squared, range, weight;

  Scalar operator()(const Pose& x_i, const Pose& x_j, Jacobians<1>* jac) const {
    const Vector2 arm_i = x_i.rotate(at_i), arm_j = x_j.rotate(at_j);
    const Vector2 ab = (x_i.position() - x_j.position()) + (arm_i - arm_j);
    const double d = std::sqrt(ab.squaredNorm() + height_squared);
    if (jac) point_pair_jacobians(x_i, x_j, arm_i, arm_j, ab * (weight / (d > kNearest ? d : kNearest)), jac);
    return Scalar((d - range) * weight);
  }
};

// Signal strength: e = (RSSI - (A - 10 eta log10 d)) / sigma, de/da = (10 eta / ln 10)(a - b) / d^2 / sigma.
struct Rssi {
  static constexpr int kDim = 1;
  static constexpr const char* kName = "rssi";
  static constexpr double kNearestSquared = 0.01;  // [m^2] d is clamped at 0.1 m, METHOD section 2
  Vector2 at_i, at_j;
  double height_squared, excess, decay, weight;  // RSSI - A; 10 eta / ln 10

  Scalar operator()(const Pose& x_i, const Pose& x_j, Jacobians<1>* jac) const {
    const Vector2 arm_i = x_i.rotate(at_i), arm_j = x_j.rotate(at_j);
    const Vector2 ab = (x_i.position() - x_j.position()) + (arm_i - arm_j);
    const double d2 = std::max(ab.squaredNorm() + height_squared, kNearestSquared);
    if (jac) point_pair_jacobians(x_i, x_j, arm_i, arm_j, ab * (weight * decay / d2), jac);
    return Scalar((excess + 0.5 * decay * std::log(d2)) * weight);
  }
};

// Bearing of a point on the target in the frame X_i B_i of the observer.
struct Bearing {
  static constexpr int kDim = 1;
  static constexpr const char* kName = "bearing";
  static constexpr double kNearestSquared = 1e-6;  // [m^2] the gradient stays bounded where the points meet
  Vector2 at_i, at_j;
  double angle, weight;  // heading of B_i + measured bearing

  Scalar operator()(const Pose& x_i, const Pose& x_j, Jacobians<1>* jac) const {
    const Vector2 arm_j = x_j.rotate(at_j);
    const Vector2 v = x_i.unrotate(x_j.position() + arm_j - x_i.position());
    const Vector2 w = v - at_i;
    if (jac) {
      const Vector2 slope = quarter_turn(w) * (weight / std::max(w.squaredNorm(), kNearestSquared));
      const Vector2 in_j = x_j.unrotate(x_i.rotate(slope));
      jac->i << -slope.x(), -slope.y(), -slope.dot(quarter_turn(v));
      jac->j << in_j.x(), in_j.y(), in_j.dot(quarter_turn(at_j));
    }
    return Scalar(wrap(std::atan2(w.y(), w.x()) - angle) * weight);
  }
};

}  // namespace dgorl
