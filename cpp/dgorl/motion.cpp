#include "dgorl/motion.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace dgorl {
namespace {

// sin t / t and (1 - cos t) / t, by series near zero.
Vector2 sinc_terms(double t) {
  if (std::abs(t) < 1e-4) return {1.0 - t * t / 6.0, t / 2.0 - t * t * t / 24.0};
  return {std::sin(t) / t, (1.0 - std::cos(t)) / t};
}

// Variances grow with time, turning and distance (METHOD section 1, odometry noise of real wheels).
Matrix3 wheel_noise(const Vector3& delta, double duration, const MotionModel& m) {
  const double distance = std::hypot(delta.x(), delta.y());
  const double standing = square(m.position_per_second) * duration;
  const double heading = square(m.heading_per_second) * duration +
                         square(m.heading_per_radian) * std::abs(delta.z()) +
                         square(m.heading_per_metre) * distance;
  return Vector3(standing + square(m.forward_per_metre) * distance,
                 standing + square(m.lateral_per_metre) * distance, heading)
      .asDiagonal();
}

Matrix3 diagonal(double position, double heading) {
  return Vector3(position, position, heading).asDiagonal();
}

Matrix3 twist_noise(double age, const MotionModel& m) {
  return diagonal(square(m.predicted_speed_sigma * age) + square(m.position_per_second) * age,
                  square(m.predicted_turn_rate_sigma * age) + square(m.heading_per_second) * age);
}

}  // namespace

std::int64_t keyframe_before(double stamp) {
  return static_cast<std::int64_t>(std::floor(stamp * kKeyframesPerSecond));
}

Pose exp(const Vector3& twist) {
  const Vector2 t = sinc_terms(twist.z());
  return {t.x() * twist.x() - t.y() * twist.y(), t.y() * twist.x() + t.x() * twist.y(), wrap(twist.z())};
}

Vector3 log(const Vector3& delta) {
  const double theta = wrap(delta.z());
  const Vector2 t = sinc_terms(theta);
  const double d = t.squaredNorm();
  return {(t.x() * delta.x() + t.y() * delta.y()) / d, (-t.y() * delta.x() + t.x() * delta.y()) / d, theta};
}

Vector3 part(const Vector3& delta, double share) {
  if (share >= 1.0) return delta;
  return exp(log(delta) * share).vec();
}

bool jumps(const OdometryRow& row, const MotionModel& m) {
  const double duration = row.end - row.start, time = row.twist ? duration : 1.0;
  const double distance = std::hypot(row.values.x(), row.values.y()) * m.linear_scale * time;
  const double turned = row.twist ? row.values.z() * time : wrap(row.values.z());
  const double longest = kBeyond * std::max(duration, kBunched);
  return distance > longest * m.maximum_speed ||
         std::abs(turned) * m.angular_scale > longest * m.maximum_turn_rate;
}

Step measured(const OdometryRow& row, const MotionModel& m) {
  const double duration = row.end - row.start;
  // A displacement's turn is known but for whole turns, a difference of headings often one too many.
  const double turned = row.twist ? row.values.z() : wrap(row.values.z());
  Vector3 motion(row.values.x() * m.linear_scale, row.values.y() * m.linear_scale, turned * m.angular_scale);
  if (row.twist) motion *= duration;
  Step step{row.start + m.lag, row.end + m.lag, row.start + m.lag, motion, Matrix3::Zero()};
  if (row.twist) {
    step.covariance = wheel_noise(motion, duration, m);
    step.delta = exp(motion).vec();
  } else if (std::isnan(row.stated[0])) {
    step.covariance = wheel_noise(motion, duration, m);
  } else {
    const double* q = row.stated;
    Matrix3 start, turn = Matrix3::Identity();
    start << q[0], q[1], q[2], q[1], q[3], q[4], q[2], q[4], q[5];
    turn.topLeftCorner<2, 2>() = Pose(0.0, 0.0, -motion.z()).rotation();
    step.covariance = turn * start * turn.transpose();
  }
  return step;
}

Step after(const Step& step, double stamp) {
  const double share = (step.end - stamp) / (step.end - step.start);
  if (share >= 1.0) return {stamp, step.end, step.origin, step.delta, step.covariance};
  return {stamp, step.end, step.origin, exp(log(step.delta) * share).vec(), step.covariance * share};
}

Step bridge(const Vector3& twist, double start, double end, double origin, const MotionModel& m) {
  const double gap = end - start;
  return {start, end, origin, exp(twist * gap).vec(), twist_noise(gap, m)};
}

Matrix3 limit_noise(double duration, const MotionModel& m) {
  return diagonal(square(m.maximum_speed * duration), square(std::min(m.maximum_turn_rate * duration, kPi)));
}

Matrix3 inverse_adjoint(const Pose& d) {
  const Vector2 turn = d.unrotate(quarter_turn(d.position()));
  Matrix3 ad;
  ad << d.c, d.s, turn.x(), -d.s, d.c, turn.y(), 0.0, 0.0, 1.0;
  return ad;
}

void Travelled::append(const Pose& d, const Matrix3& q) {
  const Matrix3 back = inverse_adjoint(d);
  const Matrix3 moved = back * covariance * back.transpose() + q;
  covariance = 0.5 * (moved + moved.transpose());
  delta = delta * d;
}

std::vector<Vector3> chain(const Pose& start, const Rows<3>& deltas) {
  if (!start.vec().allFinite()) throw std::invalid_argument("start: must be finite");
  if (!deltas.allFinite()) throw std::invalid_argument("deltas: must be finite");
  std::vector<Vector3> out{start.vec()};
  Pose pose = start;
  for (Eigen::Index k = 0; k < deltas.rows(); ++k) {
    pose = pose * Pose(deltas.data() + 3 * k);
    out.push_back(pose.vec());
  }
  return out;
}

}  // namespace dgorl
