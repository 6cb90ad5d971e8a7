#include "dgorl/relative.hpp"

namespace dgorl {
namespace {

using Index = Eigen::Index;

}  // namespace

Eigen::MatrixXd carry(const Eigen::MatrixXd& covariance, const std::vector<Travelled>& motions) {
  Eigen::MatrixXd out = covariance;
  for (std::size_t j = 0; j < motions.size(); ++j) {
    const Matrix3 back = inverse_adjoint(motions[j].delta);
    const Index at = static_cast<Index>(3 * j);
    out.middleRows<3>(at) = (back * out.middleRows<3>(at)).eval();
    out.middleCols<3>(at) = (out.middleCols<3>(at) * back.transpose()).eval();
    out.block<3, 3>(at, at) += motions[j].covariance;
  }
  return 0.5 * (out + out.transpose());
}

std::vector<Relative> relative_to(const std::vector<Pose>& poses, const Eigen::MatrixXd& covariance,
                                  std::size_t ego) {
  const Pose& own = poses[ego];
  const Index e = static_cast<Index>(3 * ego);
  const Matrix3 own_covariance = covariance.block<3, 3>(e, e);
  std::vector<Relative> out;
  for (std::size_t j = 0; j < poses.size(); ++j) {
    const Index at = static_cast<Index>(3 * j);
    const Vector2 p = own.unrotate(poses[j].position() - own.position());
    const Pose pose(p.x(), p.y(), wrap(poses[j].theta - own.theta));
    // dT = xi_j - Ad(T^-1) xi_ego in the right tangent; turned into the ego's frame.
    const Matrix3 back = inverse_adjoint(pose);
    const Matrix3 cross = covariance.block<3, 3>(at, e) * back.transpose();
    const Matrix3 tangent =
        covariance.block<3, 3>(at, at) - cross - cross.transpose() + back * own_covariance * back.transpose();
    Matrix3 turn = Matrix3::Identity();
    turn.topLeftCorner<2, 2>() = pose.rotation();
    const Matrix3 seen = turn * tangent * turn.transpose();
    out.push_back({pose, 0.5 * (seen + seen.transpose())});
  }
  return out;
}

}  // namespace dgorl
