// The linearised graph, dense, for tests and the observability analysis.
#pragma once

#include "dgorl/graph.hpp"

namespace dgorl {

// Over the free poses by index.
struct DenseNormalEquations {
  Matrix hessian;
  Vector gradient;
};
DenseNormalEquations dense_normal_equations(const Graph& graph, const Pose* poses, Weighting weighting);

// The undamped Gauss-Newton step as tangents, one row per pose, zero for fixed ones.
// Throws std::domain_error naming the pose that the graph leaves undetermined.
Matrix undamped_step(const Graph& graph, const Pose* poses);

}  // namespace dgorl
