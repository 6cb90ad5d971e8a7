// The normal equations H xi = -g of a linearised graph, and how a factor enters them.
#pragma once

#include <algorithm>

#include "dgorl/block_cholesky.hpp"
#include "dgorl/factors.hpp"
#include "dgorl/kernels.hpp"

namespace dgorl {

struct NormalEquations {
  Buffer hessian;
  Vector gradient;
  double cost = 0.0;

  explicit NormalEquations(const Layout& layout) : hessian(layout.values()), gradient(layout.variables()) {}

  void set_zero() {
    std::fill_n(hessian.data(), hessian.size(), 0.0);
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
// Hessian of rho / 2 (Triggs et al. 2000), for whitened Jacobians and g = rho' e. The Hessian gets the
// residual's own curvature too, where there is one.
template <int Dim>
void add_factor(const Edge& edge, const Jacobians<Dim>& jac, const Curvature* curvature,
                const Eigen::Matrix<double, Dim, 1>& e, double weight, double along,
                NormalEquations& normal) {
  const double whole = Dim == 1 ? along : weight;
  Jacobians<Dim> weighted{whole * jac.i, whole * jac.j};
  if (Dim > 1 && along != weight) {
    const Eigen::Matrix<double, Dim, 1> scaled = e * ((along - weight) / e.squaredNorm());
    weighted.i += scaled * (e.transpose() * jac.i);
    weighted.j += scaled * (e.transpose() * jac.j);
  }
  const Eigen::Matrix<double, Dim, 1> slope = weight * e;
  Matrix3 block;
  if (edge.start_i >= 0) {
    normal.gradient.segment<3>(edge.start_i) += jac.i.transpose() * slope;
    block.noalias() = jac.i.transpose() * weighted.i;
    if (curvature) block += weight * curvature->ii;
    normal.add(edge.ii, block);
  }
  if (edge.start_j >= 0) {
    normal.gradient.segment<3>(edge.start_j) += jac.j.transpose() * slope;
    block.noalias() = jac.j.transpose() * weighted.j;
    if (curvature) block += weight * curvature->jj;
    normal.add(edge.jj, block);
  }
  if (edge.ij.offset < 0) return;
  if (edge.j_is_row) {
    block.noalias() = jac.j.transpose() * weighted.i;
    if (curvature) block += weight * curvature->ij.transpose();
  } else {
    block.noalias() = jac.i.transpose() * weighted.j;
    if (curvature) block += weight * curvature->ij;
  }
  normal.add(edge.ij, block);
}

}  // namespace dgorl
