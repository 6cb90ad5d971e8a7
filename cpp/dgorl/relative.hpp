// Poses of a team carried on in time and seen from one of its members, with their joint covariance. METHOD
// section 1.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "dgorl/motion.hpp"

namespace dgorl {

// Joint covariance of right perturbations of poses X_j after each moved on by its own motion: X_j d_j.
Eigen::MatrixXd carry(const Eigen::MatrixXd& covariance, const std::vector<Travelled>& motions);

struct Relative {
  Pose pose;
  Matrix3 covariance;  // of (x, y, theta) in the ego's frame
};

// T_ego_j = X_ego^-1 X_j of every member, the ego itself included.
std::vector<Relative> relative_to(const std::vector<Pose>& poses, const Eigen::MatrixXd& covariance,
                                  std::size_t ego);

}  // namespace dgorl
