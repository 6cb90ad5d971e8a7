// The normal equations H xi = -g of a linearised graph, and how a factor enters them.
#pragma once

#include "dgorl/block_cholesky.hpp"
#include "dgorl/factors.hpp"
#include "dgorl/kernels.hpp"

namespace dgorl {

struct NormalEquations {
  Vector hessian, gradient;
  double cost = 0.0;

  explicit NormalEquations(const Layout& layout) : hessian(layout.values()), gradient(layout.variables()) {}

  void set_zero() {
    hessian.setZero();
    gradient.setZero();
    cost = 0.0;
  }

  void add(const Place& place, const Matrix3& m) {
    double* values = hessian.data() + place.offset;
    for (int c = 0; c < 3; ++c, values += place.stride)
      for (int r = 0; r < 3; ++r) values[r] += m(r, c);
  }
};

// The two poses of a factor and where it goes.
struct Edge {
  int i, j;
  int start_i, start_j;  // in vectors; -1: fixed
  Place ii, jj, ij;
  bool j_is_row;
  int first_block;  // the older of the two; kNoBlock when both are fixed

  Edge(const Layout& layout, int pose_i, int pose_j);
};

// Adds J'g and J'WJ, W = weight I + (along - weight) u u' with u the direction of the residual: gradient and
// Hessian of rho / 2 (Triggs et al. 2000), for whitened Jacobians and g = rho' e.
template <int Dim>
void add_factor(const Edge& edge, const Jacobians<Dim>& jac, const Eigen::Matrix<double, Dim, 1>& e,
                double weight, double along, NormalEquations& normal) {
  Jacobians<Dim> weighted{weight * jac.i, weight * jac.j};
  if (Dim > 1 && along != weight) {
    const Eigen::Matrix<double, Dim, 1> scaled = e * ((along - weight) / e.squaredNorm());
    weighted.i += scaled * (e.transpose() * jac.i);
    weighted.j += scaled * (e.transpose() * jac.j);
  } else if (Dim == 1 && along != weight) {
    weighted = {along * jac.i, along * jac.j};
  }
  const Eigen::Matrix<double, Dim, 1> slope = weight * e;
  if (edge.start_i >= 0) {
    normal.gradient.segment<3>(edge.start_i) += jac.i.transpose() * slope;
    normal.add(edge.ii, jac.i.transpose() * weighted.i);
  }
  if (edge.start_j >= 0) {
    normal.gradient.segment<3>(edge.start_j) += jac.j.transpose() * slope;
    normal.add(edge.jj, jac.j.transpose() * weighted.j);
  }
  if (edge.ij.offset >= 0) {
    if (edge.j_is_row)
      normal.add(edge.ij, jac.j.transpose() * weighted.i);
    else
      normal.add(edge.ij, jac.i.transpose() * weighted.j);
  }
}

inline void add_curvature(const Edge& edge, const Curvature& curvature, double weight,
                          NormalEquations& normal) {
  if (edge.start_i >= 0) normal.add(edge.ii, weight * curvature.ii);
  if (edge.start_j >= 0) normal.add(edge.jj, weight * curvature.jj);
  if (edge.ij.offset < 0) return;
  if (edge.j_is_row)
    normal.add(edge.ij, weight * curvature.ij.transpose());
  else
    normal.add(edge.ij, weight * curvature.ij);
}

}  // namespace dgorl
