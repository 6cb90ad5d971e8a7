#include "dgorl/evidence.hpp"

#include <cmath>

#include "dgorl/covariance.hpp"

namespace dgorl {

Evidence evidence(const Graph& graph, const Pose* poses, const std::vector<int>& select,
                  const std::vector<int>& soft, const Rows<3>& pi) {
  const Layout& layout = graph.layout();
  NormalEquations normal(layout);
  graph.linearize(poses, Weighting::kIrls, normal);
  for (std::size_t k = 0; k < soft.size(); ++k)
    if (!layout.fixed(soft[k]))
      normal.add(layout.place(soft[k], soft[k], nullptr),
                 Matrix3(pi.row(static_cast<Eigen::Index>(k)).asDiagonal()));
  BlockCholesky cholesky(layout);
  Evidence out;
  out.covariance = joint_covariance(layout, normal, cholesky, select);
  for (int b = 0; b < layout.blocks(); ++b)
    out.log_determinant += 2.0 * cholesky.diagonal(b).diagonal().array().log().sum();
  return out;
}

}  // namespace dgorl
