#include "dgorl/marginalize.hpp"

#include "dgorl/covariance.hpp"

namespace dgorl {

Marginal marginalize(const Graph& graph, const Pose* poses, std::int64_t slot) {
  const Layout& layout = graph.layout();
  int block = 0;
  while (block < layout.blocks() && layout.panel(block).slot < slot) ++block;

  // Only factors that touch an eliminated pose; elimination is the first part of the factorisation, and what
  // it leaves in the next block is the Schur complement.
  NormalEquations normal(layout);
  graph.linearize(poses, Weighting::kIrls, normal, block);
  BlockCholesky cholesky(layout);
  const int failed = cholesky.factorize(normal.hessian, 0.0, block);
  if (failed >= 0) throw_undetermined(failed);
  Matrix gradient = normal.gradient;
  cholesky.forward(gradient, 0, block);

  Marginal out;
  out.kept = graph.touched(block);
  const Eigen::Index k = static_cast<Eigen::Index>(out.kept.size());
  out.information.resize(3 * k, 3 * k);
  out.gradient.resize(3 * k);
  if (k == 0) return out;
  const ConstBlock schur = cholesky.diagonal(block);
  for (Eigen::Index a = 0; a < k; ++a) {
    const int row = layout.column(out.kept[a]);
    out.gradient.segment<3>(3 * a) = gradient.block<3, 1>(layout.start(out.kept[a]), 0);
    for (Eigen::Index b = 0; b <= a; ++b) {
      const int col = layout.column(out.kept[b]);
      Matrix3 m = schur.block<3, 3>(row, col);
      if (a == b) m = m.selfadjointView<Eigen::Lower>();
      out.information.block<3, 3>(3 * a, 3 * b) = m;
      out.information.block<3, 3>(3 * b, 3 * a) = m.transpose();
    }
  }
  return out;
}

}  // namespace dgorl
