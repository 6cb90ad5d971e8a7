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

// Adds w J'J and J'g of one factor with whitened Jacobians.
template <int Dim>
void add_factor(const Edge& edge, const Jacobians<Dim>& jac, double weight,
                const Eigen::Matrix<double, Dim, 1>& slope, NormalEquations& normal) {
  if (edge.start_i >= 0) {
    normal.gradient.segment<3>(edge.start_i) += jac.i.transpose() * slope;
    normal.add(edge.ii, jac.i.transpose() * (weight * jac.i));
  }
  if (edge.start_j >= 0) {
    normal.gradient.segment<3>(edge.start_j) += jac.j.transpose() * slope;
    normal.add(edge.jj, jac.j.transpose() * (weight * jac.j));
  }
  if (edge.ij.offset >= 0) {
    if (edge.j_is_row)
      normal.add(edge.ij, jac.j.transpose() * (weight * jac.i));
    else
      normal.add(edge.ij, jac.i.transpose() * (weight * jac.j));
  }
}

// As above for a robust kernel: gradient rho' J'e, Hessian J'(rho' I + 2 rho'' e e')J (Triggs) or rho' J'J
// (IRLS).
template <int Dim>
void add_robust_factor(const Edge& edge, Jacobians<Dim>& jac, const Kernel::Rho& rho, Weighting weighting,
                       const Eigen::Matrix<double, Dim, 1>& e, NormalEquations& normal) {
  const double along = Kernel::hessian_weight(rho, weighting);
  const Eigen::Matrix<double, Dim, 1> slope = rho.weight * e;
  if (Dim == 1) return add_factor<Dim>(edge, jac, along, slope, normal);
  const double norm = e.norm();
  if (along == rho.weight || norm == 0.0) return add_factor<Dim>(edge, jac, rho.weight, slope, normal);
  // Along the residual the Hessian has another weight: shrink that component, restore the gradient with it.
  const double shrink = std::sqrt(along / rho.weight);
  const Eigen::Matrix<double, Dim, 1> unit = e / norm;
  jac.i += unit * ((shrink - 1.0) * (unit.transpose() * jac.i));
  jac.j += unit * ((shrink - 1.0) * (unit.transpose() * jac.j));
  add_factor<Dim>(edge, jac, rho.weight, slope / shrink, normal);
}

}  // namespace dgorl
