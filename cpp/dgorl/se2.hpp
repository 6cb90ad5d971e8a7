// SE(2): poses with their rotation, and the angle wrap. T_a_b maps b into a; perturbations on the right.
#pragma once

#include <Eigen/Core>
#include <cmath>

namespace dgorl {

using Vector2 = Eigen::Vector2d;
using Vector3 = Eigen::Vector3d;
using Matrix2 = Eigen::Matrix2d;
using Matrix3 = Eigen::Matrix3d;

constexpr double kPi = 3.14159265358979323846;

// Angle in (-pi, pi]. Almost every angle is already there, and std::remainder is slow.
inline double wrap(double angle) {
  if (angle > -kPi && angle <= kPi) return angle;
  const double r = std::remainder(angle, 2.0 * kPi);
  return r <= -kPi ? kPi : r;
}

// The generator of rotations: d/dtheta R(theta) v = R(theta) quarter_turn(v).
inline Vector2 quarter_turn(const Vector2& v) { return {-v.y(), v.x()}; }

// A pose with the cosine and sine of its heading, which every factor at that pose needs.
struct Pose {
  double x = 0.0, y = 0.0, theta = 0.0, c = 1.0, s = 0.0;

  Pose() = default;
  Pose(double x_, double y_, double theta_)
      : x(x_), y(y_), theta(theta_), c(std::cos(theta_)), s(std::sin(theta_)) {}
  explicit Pose(const double* xyt) : Pose(xyt[0], xyt[1], xyt[2]) {}

  Vector2 position() const { return {x, y}; }
  Vector2 rotate(const Vector2& v) const { return {c * v.x() - s * v.y(), s * v.x() + c * v.y()}; }
  Vector2 unrotate(const Vector2& v) const { return {c * v.x() + s * v.y(), c * v.y() - s * v.x()}; }
  Vector2 transform(const Vector2& v) const { return position() + rotate(v); }
  Matrix2 rotation() const { return (Matrix2() << c, -s, s, c).finished(); }
  Vector3 vec() const { return {x, y, theta}; }

  Pose operator*(const Pose& other) const {
    const Vector2 p = transform(other.position());
    return {p.x(), p.y(), wrap(theta + other.theta)};
  }

  // X . Exp(xi): twists that belong to one rigid motion move all poses rigidly, however far.
  Pose exp(double xi_x, double xi_y, double xi_theta) const {
    const double t = xi_theta, half = 0.5 * t;
    const double a = std::abs(t) < 1e-4 ? 1.0 - t * t / 6.0 : std::sin(t) / t;
    const double b = std::abs(t) < 1e-4 ? half * (1.0 - t * t / 12.0) : (1.0 - std::cos(t)) / t;
    return retract(a * xi_x - b * xi_y, b * xi_x + a * xi_y, t);
  }

  // X . xi with xi taken as a pose: to first order X . Exp(xi), and cheaper (METHOD section 1, tangent).
  Pose retract(double xi_x, double xi_y, double xi_theta) const {
    const Vector2 p = transform({xi_x, xi_y});
    return {p.x(), p.y(), wrap(theta + xi_theta)};
  }
};

}  // namespace dgorl
