#include "dgorl/odometry.hpp"

#include <stdexcept>
#include <string>

namespace dgorl {
namespace {

void check_finite(const char* name, bool finite) {
  if (!finite) throw std::invalid_argument(std::string(name) + ": must be finite");
}

// Ad(d^-1) for components (x, y, theta): moves a right perturbation from before d to after it.
Matrix3 inverse_adjoint(const Pose& d) {
  const Vector2 turn = d.unrotate(quarter_turn(d.position()));
  Matrix3 ad;
  ad << d.c, d.s, turn.x(), -d.s, d.c, turn.y(), 0.0, 0.0, 1.0;
  return ad;
}

}  // namespace

std::vector<Preintegrated> preintegrate(const Rows<3>& deltas, const Rows<6>& covariances,
                                        const Indices& counts) {
  check_finite("deltas", deltas.allFinite());
  check_finite("covariances", covariances.allFinite());
  if (covariances.rows() != deltas.rows())
    throw std::invalid_argument("covariances: must have one row per delta, " + std::to_string(deltas.rows()));
  if (counts.size() && counts.minCoeff() < 0) throw std::invalid_argument("counts: must not be negative");
  Eigen::Index left = deltas.rows();
  for (Eigen::Index k = 0; k < counts.size() && left >= 0; ++k)
    left = counts[k] > left ? -1 : left - counts[k];
  if (left != 0)
    throw std::invalid_argument("counts: must sum to the number of deltas, " + std::to_string(deltas.rows()));

  std::vector<Preintegrated> out;
  Eigen::Index at = 0;
  for (Eigen::Index k = 0; k < counts.size(); ++k) {
    Pose sum;
    Matrix3 covariance = Matrix3::Zero();
    for (const Eigen::Index end = at + counts[k]; at < end; ++at) {
      const Pose d(deltas.data() + 3 * at);
      const auto q = covariances.row(at);
      const Matrix3 ad = inverse_adjoint(d), before = covariance;
      covariance << q[0], q[1], q[2], q[1], q[3], q[4], q[2], q[4], q[5];
      covariance += ad * before * ad.transpose();
      sum = sum * d;
    }
    out.push_back({sum.vec(), 0.5 * (covariance + covariance.transpose())});
  }
  return out;
}

std::vector<Vector3> chain(const Pose& start, const Rows<3>& deltas) {
  check_finite("start", start.vec().allFinite());
  check_finite("deltas", deltas.allFinite());
  std::vector<Vector3> out{start.vec()};
  Pose pose = start;
  for (Eigen::Index k = 0; k < deltas.rows(); ++k) {
    pose = pose * Pose(deltas.data() + 3 * k);
    out.push_back(pose.vec());
  }
  return out;
}

}  // namespace dgorl
