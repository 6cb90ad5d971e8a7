// How much posterior mass lies round an optimum: Laplace's method. METHOD section 4.
#pragma once

#include <vector>

#include "dgorl/graph.hpp"

namespace dgorl {

struct Evidence {
  double log_determinant = 0.0;  // of H + Pi over the free poses
  Matrix covariance;             // joint, of the selected poses, under H + Pi
};

// Pi: a weak prior without a pull, diag(pi row) on each of the poses `soft`, which makes H proper where the
// measurements say nothing. Throws std::domain_error naming the pose that even so is undetermined.
Evidence evidence(const Graph& graph, const Pose* poses, const std::vector<int>& select,
                  const std::vector<int>& soft, const Rows<3>& pi);

}  // namespace dgorl
