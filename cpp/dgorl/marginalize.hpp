// Schur complement of the oldest slots onto the poses they touch. METHOD section 1, nodes.
#pragma once

#include <vector>

#include "dgorl/graph.hpp"

namespace dgorl {

struct Marginal {
  std::vector<int> kept;  // ascending
  Matrix information;
  Vector gradient;  // of the cost at the poses, by the right perturbations of the kept poses
};

Marginal marginalize(const Graph& graph, const Pose* poses, std::int64_t slot);

}  // namespace dgorl
