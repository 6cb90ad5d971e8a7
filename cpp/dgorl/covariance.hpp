// Joint covariances: blocks of the inverse Hessian.
#pragma once

#include <vector>

#include "dgorl/graph.hpp"

namespace dgorl {

// Poses by index, any slots and order; fixed ones have zero blocks. Factorises `normal` into `cholesky`.
// Throws std::domain_error naming the pose that the graph leaves undetermined.
Matrix joint_covariance(const Layout& layout, const NormalEquations& normal, BlockCholesky& cholesky,
                        const std::vector<int>& select);

// The selected indices as ints; throws std::invalid_argument, naming the argument, for one out of range.
std::vector<int> checked_selection(const Layout& layout, const Indices& select, const char* name = "select");

[[noreturn]] void throw_undetermined(int pose);

}  // namespace dgorl
