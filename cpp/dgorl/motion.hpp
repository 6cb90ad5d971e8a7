// Odometry as motion increments with noise: the paper's motion model f, for real wheels. METHOD section 1.
#pragma once

#include <cstdint>
#include <vector>

#include "dgorl/arrays.hpp"
#include "dgorl/se2.hpp"

namespace dgorl {

constexpr double kKeyframesPerSecond = 2.0;  // keyframes stand at multiples of 0.5 s of the robot's clock
constexpr double kHeld = 1.0;                // odometry missing for longer [s] is a gap: it ends the track

constexpr double kBeyond = 5.0;  // so many times faster than the limits is no motion but a jump of the sensor
constexpr double kBunched = 0.1;  // ... over this [s] at least: stamps of short rows may be bunched

constexpr double kRounding = 1e-6;  // odometry nearer than this [s] follows on: the resolution of stamps

inline double square(double x) { return x * x; }

// The settings of dgorl.configuration.Motion, in its order.
struct MotionModel {
  double linear_scale, angular_scale, lag;
  double heading_per_second, heading_per_radian, heading_per_metre;
  double forward_per_metre, lateral_per_metre, position_per_second;
  double maximum_speed, maximum_turn_rate, predicted_speed_sigma, predicted_turn_rate_sigma;
};

// Motion over [start, end] of constant twist; covariance of its right perturbation. origin: start of the
// odometry that made it known, which for a bridged gap lies after it.
struct Step {
  double start, end, origin;
  Vector3 delta;
  Matrix3 covariance;
};

// One row of odometry as it was measured.
struct OdometryRow {
  double start, end;
  std::int64_t epoch;
  bool twist;        // values are a twist (v, 0, omega), else a displacement
  Vector3 values;    // [m/s, m/s, rad/s] or [m, m, rad]
  double stated[6];  // covariance of a displacement in the frame at its start, upper triangle; NaN where not
                     // stated
};

// The newest keyframe at or before a stamp.
std::int64_t keyframe_before(double stamp);

Pose exp(const Vector3& twist);     // pose after one unit of time
Vector3 log(const Vector3& delta);  // the twist that makes delta in one unit of time
Vector3 part(const Vector3& delta, double share);

// Whether a row tells of a jump: an encoder that was reset, a pose that was corrected. It is no motion.
bool jumps(const OdometryRow& row, const MotionModel& model);

// Scaled, shifted by the wheels' lag, with its noise.
Step measured(const OdometryRow& row, const MotionModel& model);

// The part of a step after a stamp inside it.
Step after(const Step& step, double stamp);

// A robot of which nothing is known between two stamps, at most kHeld apart: it goes on with the last twist.
Step bridge(const Vector3& twist, double start, double end, double origin, const MotionModel& model);

// What motion limits say of a time of which nothing else is known.
Matrix3 limit_noise(double duration, const MotionModel& model);

// Ad(d^-1): moves a right perturbation from before d to after it.
Matrix3 inverse_adjoint(const Pose& d);

// Consecutive motions composed: S <- Ad(d^-1) S Ad(d^-1)' + Q, S the covariance of the right perturbation.
struct Travelled {
  Pose delta;
  Matrix3 covariance = Matrix3::Zero();

  void append(const Pose& d, const Matrix3& q);
};

// start, start d1, start d1 d2, ...
std::vector<Vector3> chain(const Pose& start, const Rows<3>& deltas);

}  // namespace dgorl
