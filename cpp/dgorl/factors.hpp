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

// Second derivatives of a factor's residual, weighted with that residual and summed: sum_k e_k d2e_k along
// x += R xi_xy, theta += xi_theta. What Newton's Hessian has and Gauss-Newton's lacks.
struct Curvature {
  Matrix3 ii, ij, jj;
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

  // Of R_i'(p_j + R_j t - p_i) = v, weighted with `pull`; arm = R_i'R_j t.
  static void set_curvature(const Pose& x_i, const Pose& x_j, const Vector2& arm, const Vector2& v,
                            const Vector2& pull, Curvature* out) {
    const Vector2 turn = quarter_turn(pull);
    out->ii.setZero();
    out->ij.setZero();
    out->jj.setZero();
    out->ii.topRightCorner<2, 1>() = -turn;
    out->ii.bottomLeftCorner<1, 2>() = -turn.transpose();
    out->ii(2, 2) = -pull.dot(v);
    out->ij.bottomLeftCorner<1, 2>() = x_j.unrotate(x_i.rotate(turn)).transpose();
    out->ij(2, 2) = pull.dot(arm);
    out->jj(2, 2) = -pull.dot(arm);
  }

  Vector3 operator()(const Pose& x_i, const Pose& x_j, Jacobians<3>* jac, Curvature* curvature) const {
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
    const Vector3 e =
        root.col(0) * t.x() + root.col(1) * t.y() + root.col(2) * wrap(x_j.theta - x_i.theta - angle);
    if (curvature)
      set_curvature(x_i, x_j, x_i.unrotate(arm_j), v, {root.col(0).dot(e), root.col(1).dot(e)}, curvature);
    return e;
  }
};

using Scalar = Eigen::Matrix<double, 1, 1>;

// A function of the vector ab from a point b on body j to a point a on body i: every scalar factor is one.
struct PointPair {
  const Pose &x_i, &x_j;
  Vector2 arm_i, arm_j, ab;

  PointPair(const Pose& pose_i, const Pose& pose_j, const Vector2& at_i, const Vector2& at_j)
      : x_i(pose_i),
        x_j(pose_j),
        arm_i(pose_i.rotate(at_i)),
        arm_j(pose_j.rotate(at_j)),
        ab((pose_i.position() - pose_j.position()) + (arm_i - arm_j)) {}

  void jacobians(const Vector2& slope, Jacobians<1>* jac) const {
    const Vector2 in_i = x_i.unrotate(slope), in_j = x_j.unrotate(slope);
    jac->i << in_i.x(), in_i.y(), slope.dot(quarter_turn(arm_i));
    jac->j << -in_j.x(), -in_j.y(), -slope.dot(quarter_turn(arm_j));
  }

  // From the first and second derivatives by ab, both times the residual.
  void curvature(const Vector2& slope, const Matrix2& bend, Curvature* out) const {
    Eigen::Matrix<double, 2, 3> a, b;
    a << x_i.c, -x_i.s, -arm_i.y(), x_i.s, x_i.c, arm_i.x();
    b << x_j.c, -x_j.s, -arm_j.y(), x_j.s, x_j.c, arm_j.x();
    const Eigen::Matrix<double, 2, 3> bend_b = bend * b;
    out->ii.noalias() = a.transpose() * (bend * a);
    out->ij.noalias() = -a.transpose() * bend_b;
    out->jj.noalias() = b.transpose() * bend_b;
    out->ii(2, 2) -= slope.dot(arm_i);
    out->jj(2, 2) += slope.dot(arm_j);
  }
};

// Metric range: e = (d - r) / sigma, d the slant distance between two antennas.
struct Range {
  static constexpr int kDim = 1;
  static constexpr const char* kName = "range";
  static constexpr double kNearest = 1e-3;  // [m] the gradient stays bounded where the antennas meet
  Vector2 at_i, at_j;
  double height_squared, range, weight;

  Scalar operator()(const Pose& x_i, const Pose& x_j, Jacobians<1>* jac, Curvature* curvature) const {
    const PointPair pair(x_i, x_j, at_i, at_j);
    const double d = std::sqrt(pair.ab.squaredNorm() + height_squared);
    const Scalar e((d - range) * weight);
    if (jac) {
      const double per_d = 1.0 / std::max(d, kNearest);
      const Vector2 unit = pair.ab * per_d;
      pair.jacobians(weight * unit, jac);
      if (curvature) {
        const double scale = e[0] * weight;
        pair.curvature(scale * unit, scale * per_d * (Matrix2::Identity() - unit * unit.transpose()),
                       curvature);
      }
    }
    return e;
  }
};

// Signal strength: e = (RSSI - (A - 10 eta log10 d)) / sigma, de/da = (10 eta / ln 10)(a - b) / d^2 / sigma.
struct Rssi {
  static constexpr int kDim = 1;
  static constexpr const char* kName = "rssi";
  static constexpr double kNearestSquared = 0.01;  // [m^2] d is clamped at 0.1 m, METHOD section 2
  Vector2 at_i, at_j;
  double height_squared, excess, decay, weight;  // RSSI - A; 10 eta / ln 10

  Scalar operator()(const Pose& x_i, const Pose& x_j, Jacobians<1>* jac, Curvature* curvature) const {
    const PointPair pair(x_i, x_j, at_i, at_j);
    const double d2 = std::max(pair.ab.squaredNorm() + height_squared, kNearestSquared);
    const Scalar e((excess + 0.5 * decay * std::log(d2)) * weight);
    if (jac) {
      const double per_d2 = 1.0 / d2, scale = weight * decay * per_d2;
      pair.jacobians(scale * pair.ab, jac);
      if (curvature) {
        const Vector2 slope = (e[0] * scale) * pair.ab;
        pair.curvature(slope, e[0] * scale * Matrix2::Identity() - 2.0 * per_d2 * slope * pair.ab.transpose(),
                       curvature);
      }
    }
    return e;
  }
};

// Bearing of a point on the target in the frame X_i B_i of the observer.
struct Bearing {
  static constexpr int kDim = 1;
  static constexpr const char* kName = "bearing";
  static constexpr double kNearestSquared = 1e-6;  // [m^2] the gradient stays bounded where the points meet
  Vector2 at_i, at_j;
  double angle, weight;  // heading of B_i + measured bearing

  Scalar operator()(const Pose& x_i, const Pose& x_j, Jacobians<1>* jac, Curvature* curvature) const {
    const PointPair pair(x_i, x_j, at_i, at_j);
    const Vector2& ab = pair.ab;
    const Scalar e(wrap(std::atan2(-ab.y(), -ab.x()) - x_i.theta - angle) * weight);
    if (jac) {
      const double per_d2 = 1.0 / std::max(ab.squaredNorm(), kNearestSquared);
      const Vector2 slope = quarter_turn(ab) * (weight * per_d2);
      pair.jacobians(slope, jac);
      jac->i[2] -= weight;
      if (curvature) {
        const Matrix2 half = (-per_d2 * e[0]) * ab * slope.transpose();
        pair.curvature(e[0] * slope, half + half.transpose(), curvature);
      }
    }
    return e;
  }
};

}  // namespace dgorl
