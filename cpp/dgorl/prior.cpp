#include "dgorl/prior.hpp"

#include <algorithm>

namespace dgorl {

Prior::Prior(const Layout& layout, int reference, std::vector<int> members, std::vector<Pose> relative,
             const Matrix& information, const Vector& gradient)
    : layout_(layout),
      reference_(reference),
      members_(std::move(members)),
      variables_(members_),
      relative_(std::move(relative)),
      information_(information),
      gradient_(gradient) {
  if (reference >= 0) variables_.push_back(reference);
  for (int pose : variables_) first_block_ = std::min(first_block_, layout.block(pose));
  for (std::size_t k = 0; k < relative_.size(); ++k) {
    const Matrix2 r = relative_[k].rotation();
    const auto at = static_cast<Eigen::Index>(3 * k);
    information_.middleRows<2>(at) = r * information_.middleRows<2>(at).eval();
    information_.middleCols<2>(at) = information_.middleCols<2>(at).eval() * r.transpose();
    gradient_.segment<2>(at) = r * gradient_.segment<2>(at).eval();
  }
}

Vector Prior::delta(const Pose* poses) const {
  const Pose origin;
  const Pose& x_ref = reference_ >= 0 ? poses[reference_] : origin;
  Vector out(3 * members_.size());
  for (std::size_t k = 0; k < members_.size(); ++k) {
    const Pose &x = poses[members_[k]], &z = relative_[k];
    out.segment<2>(3 * k) = x_ref.unrotate(x.position() - x_ref.position()) - z.position();
    out[3 * k + 2] = wrap(x.theta - x_ref.theta - z.theta);
  }
  return out;
}

Matrix Prior::residual(const Pose* poses) const {
  const Vector d = delta(poses);
  Matrix out(members_.size(), 3);
  for (std::size_t k = 0; k < members_.size(); ++k) {
    out.row(k).head<2>() = relative_[k].unrotate(d.segment<2>(3 * k)).transpose();
    out(k, 2) = d[3 * k + 2];
  }
  return out;
}

double Prior::cost(const Pose* poses) const {
  const Vector d = delta(poses);
  return d.dot(0.5 * (information_ * d) + gradient_);
}

// Columns: each member's own three, then those of the reference.
Matrix Prior::jacobian(const Pose* poses) const {
  const Pose origin;
  const Pose& x_ref = reference_ >= 0 ? poses[reference_] : origin;
  const Eigen::Index m = static_cast<Eigen::Index>(3 * members_.size());
  Matrix jac = Matrix::Zero(m, 3 * variables_.size());
  for (Eigen::Index k = 0; k < m; k += 3) {
    const Pose& x = poses[members_[k / 3]];
    jac.block<2, 2>(k, k) = x_ref.rotation().transpose() * x.rotation();
    jac(k + 2, k + 2) = 1.0;
    if (reference_ < 0) continue;
    const Vector2 v = x_ref.unrotate(x.position() - x_ref.position());
    jac.block<3, 3>(k, m) = -Matrix3::Identity();
    jac.block<2, 1>(k, m + 2) = -quarter_turn(v);
  }
  return jac;
}

// Second derivatives of delta, weighted with pull = H delta + g; without a reference it has none.
void Prior::add_curvature(const Pose* poses, const Vector& pull, Matrix& hessian) const {
  if (reference_ < 0) return;
  const Pose& x_ref = poses[reference_];
  const Eigen::Index r = static_cast<Eigen::Index>(3 * members_.size());
  for (Eigen::Index k = 0; k < r; k += 3) {
    const Pose& x = poses[members_[k / 3]];
    Curvature c;
    RelativePose::set_curvature(x_ref, x, Vector2::Zero(), x_ref.unrotate(x.position() - x_ref.position()),
                                pull.segment<2>(k), &c);
    hessian.block<3, 3>(r, r) += c.ii;
    hessian.block<3, 3>(r, k) += c.ij;
    hessian.block<3, 3>(k, r) += c.ij.transpose();
  }
}

void Prior::linearize(const Pose* poses, bool newton, NormalEquations& normal) const {
  const Vector d = delta(poses);
  const Matrix jac = jacobian(poses);
  const Vector product = information_ * d;
  normal.cost += d.dot(0.5 * product + gradient_);
  const Vector pull = product + gradient_, gradient = jac.transpose() * pull;
  Matrix hessian = jac.transpose() * (information_ * jac);
  if (newton) add_curvature(poses, pull, hessian);
  for (std::size_t a = 0; a < variables_.size(); ++a) {
    if (layout_.fixed(variables_[a])) continue;
    normal.gradient.segment<3>(layout_.start(variables_[a])) += gradient.segment<3>(3 * a);
    for (std::size_t b = 0; b <= a; ++b) {
      int row = variables_[a];
      const Place place = layout_.place(variables_[a], variables_[b], &row);
      if (place.offset < 0) continue;
      const Matrix3 block = hessian.block<3, 3>(3 * a, 3 * b);
      normal.add(place, row == variables_[a] ? block : Matrix3(block.transpose()));
    }
  }
}

}  // namespace dgorl
