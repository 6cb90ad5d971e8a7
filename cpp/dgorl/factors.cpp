#include "dgorl/factors.hpp"

namespace dgorl {

RelativePose::RelativePose(const Pose& T_i_at, const Pose& T_j_at, const Pose& delta,
                           const Matrix3& upper_root)
    : at_j(T_j_at.position()) {
  const Pose z = T_i_at * delta;
  target = z.position();
  angle = z.theta - T_j_at.theta;
  root = upper_root;
  root.leftCols<2>() = upper_root.leftCols<2>() * z.rotation().transpose();
}

}  // namespace dgorl
