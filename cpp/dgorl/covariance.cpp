#include "dgorl/covariance.hpp"

#include <algorithm>
#include <stdexcept>
#include <string>

namespace dgorl {

void throw_undetermined(int pose) {
  throw std::domain_error("the graph leaves pose " + std::to_string(pose) +
                          " undetermined: fix a pose of its component or add factors");
}

std::vector<int> checked_selection(const Layout& layout, const Indices& select, const char* name) {
  std::vector<int> out;
  for (Eigen::Index k = 0; k < select.size(); ++k) {
    if (select[k] < 0 || select[k] >= layout.poses())
      throw std::invalid_argument(std::string(name) + ": must be a pose index below " +
                                  std::to_string(layout.poses()) + " (row " + std::to_string(k) + ")");
    out.push_back(static_cast<int>(select[k]));
  }
  return out;
}

// With H = L L', E'H^-1 E = (L^-1 E)'(L^-1 E), and L^-1 E is zero before the oldest selected slot: only the
// tail of the factor is touched.
Matrix joint_covariance(const Layout& layout, const NormalEquations& normal, BlockCholesky& cholesky,
                        const std::vector<int>& select) {
  const int failed = cholesky.factorize(normal.hessian, 0.0);
  if (failed >= 0) throw_undetermined(failed);
  const Eigen::Index columns = static_cast<Eigen::Index>(3 * select.size());
  int first = layout.blocks();
  for (int pose : select)
    if (!layout.fixed(pose)) first = std::min(first, layout.block(pose));
  if (first == layout.blocks()) return Matrix::Zero(columns, columns);
  const int skip = layout.panel(first).start;
  Matrix y = Matrix::Zero(layout.variables() - skip, columns);
  for (std::size_t k = 0; k < select.size(); ++k)
    if (!layout.fixed(select[k]))
      y.block<3, 3>(layout.start(select[k]) - skip, static_cast<Eigen::Index>(3 * k)).setIdentity();
  cholesky.forward(y, first);
  Matrix out = Matrix::Zero(columns, columns);
  out.selfadjointView<Eigen::Lower>().rankUpdate(y.transpose());
  out.triangularView<Eigen::StrictlyUpper>() = out.transpose();
  return out;
}

}  // namespace dgorl
