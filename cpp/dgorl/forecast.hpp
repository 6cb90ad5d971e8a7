// Where a robot is whose odometry has not come yet, and how sure that is. METHOD section 1, now.
#pragma once

#include "dgorl/habit.hpp"

namespace dgorl {

constexpr double kForeseen = 10.0;  // longer than that [s] the motion limits alone hold

// Motion over a duration [s] after a row of this twist.
Travelled forecast(const Habit& habit, const Vector3& twist, double duration, const MotionModel& model);

}  // namespace dgorl
