// The dense work of the block Cholesky: one slot's panel [D; C].
#pragma once

#include "dgorl/layout.hpp"

namespace dgorl {

// A pivot below this share of its diagonal entry is rounding: the variable is undetermined.
constexpr double kSingular = 2e-13;

constexpr int kStrip = 24;       // columns that stay in cache while they are worked on
constexpr int kLargePanel = 96;  // from this size on products of whole strips win over small tiles

// In place on `values`, which starts as a copy of `hessian`: damps the diagonal, D = L L', C <- C L^-T, and
// the next slot's D <- D - C C'. Returns -1, or the row in the slot of the pivot that vanished.
int factorize_panel(const Layout& layout, int block, const double* hessian, double damping, double* values);

}  // namespace dgorl
