// How a robot drives, as its own odometry tells: an autoregression of its twist. METHOD section 1, now.
#pragma once

#include <vector>

#include "dgorl/motion.hpp"

namespace dgorl {

// Twists of consecutive samples, by component: u' = mean + keep (u - mean) + e + d, where e ~ N(0, shock) is
// new with every sample and d ~ N(0, drift) is the same for all that are foreseen.
struct Habit {
  using Array = Eigen::Array3d;

  Array mean, keep, shock, drift;  // [m/s, m/s, rad/s] and their squares
  double length;                   // of a sample [s]
  double position, heading;        // variances of odometry a second [m^2, rad^2]
};

// The samples of one track: whole rows of odometry together, until the first that reaches a keyframe's time.
class DriveRecord {
 public:
  // Takes a row that follows on; one that was not measured tells nothing.
  void append(const Step& step, bool measured);
  // Drops what ended by a stamp.
  void forget(double stamp);
  // From the samples of the kLearnt seconds before a stamp that ended by `from`, when a row of this twist
  // did.
  Habit habit(const Vector3& twist, double from, double stamp, const MotionModel& model) const;

 private:
  struct Sample {
    double start = 0.0, end = 0.0;
    Vector3 mean = Vector3::Zero();  // twist over all of it
    Vector3 last = Vector3::Zero();  // twist of its last row
    double position = 0.0, heading = 0.0;
  };

  std::vector<Sample> samples_;
  Sample open_;
};

constexpr double kLearnt = 30.0;  // [s] raw data is kept longer than that, however short the window

}  // namespace dgorl
