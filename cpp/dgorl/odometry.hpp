// Preintegration of odometry sub-steps. METHOD section 1, keyframes.
#pragma once

#include <vector>

#include "dgorl/arrays.hpp"
#include "dgorl/se2.hpp"

namespace dgorl {

struct Preintegrated {
  Vector3 delta;
  Matrix3 covariance;
};

// Groups of consecutive sub-steps composed; S <- Ad(d^-1) S Ad(d^-1)' + Q for a sub-step d, S in the frame at
// the end. Covariances of sub-steps: xx, xy, xt, yy, yt, tt.
std::vector<Preintegrated> preintegrate(const Rows<3>& deltas, const Rows<6>& covariances,
                                        const Indices& counts);

// start, start d1, start d1 d2, ...
std::vector<Vector3> chain(const Pose& start, const Rows<3>& deltas);

}  // namespace dgorl
