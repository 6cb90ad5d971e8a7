// A dense prior on the poses of members relative to a reference, as marginalisation leaves it. METHOD
// section 1.
#pragma once

#include <vector>

#include "dgorl/normal_equations.hpp"

namespace dgorl {

// Cost delta' H delta / 2 + g' delta, delta_j = vec(Z_j^-1 X_ref^-1 X_j). Kept in the frame of the reference:
// delta is stored as (R_ref'(p_j - p_ref) - t_Z, theta_j - theta_ref - theta_Z), H and g rotated by Z to
// match.
class Prior {
 public:
  static constexpr const char* kName = "prior";

  // reference -1: none, the members' poses themselves.
  Prior(const Layout& layout, int reference, std::vector<int> members, std::vector<Pose> relative,
        const Matrix& information, const Vector& gradient);

  double cost(const Pose* poses) const;
  void linearize(const Pose* poses, bool newton, NormalEquations& normal) const;
  Matrix residual(const Pose* poses) const;  // delta as it is defined, one row per member
  int first_block() const { return first_block_; }
  const std::vector<int>& variables() const { return variables_; }

 private:
  Vector delta(const Pose* poses) const;
  Matrix jacobian(const Pose* poses) const;
  void add_curvature(const Pose* poses, const Vector& pull, Matrix& hessian) const;

  const Layout& layout_;
  int reference_;
  std::vector<int> members_, variables_;
  std::vector<Pose> relative_;
  Matrix information_;
  Vector gradient_;
  int first_block_ = kNoBlock;
};

}  // namespace dgorl
