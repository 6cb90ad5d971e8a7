#include "dgorl/inspect.hpp"

#include "dgorl/covariance.hpp"

namespace dgorl {

DenseNormalEquations dense_normal_equations(const Graph& graph, const Pose* poses, Weighting weighting) {
  const Layout& layout = graph.layout();
  NormalEquations normal(layout);
  graph.linearize(poses, weighting, normal);
  std::vector<int> free;
  for (int k = 0; k < layout.poses(); ++k)
    if (!layout.fixed(k)) free.push_back(k);
  DenseNormalEquations out{Matrix::Zero(layout.variables(), layout.variables()), Vector(layout.variables())};
  for (std::size_t a = 0; a < free.size(); ++a) {
    out.gradient.segment<3>(3 * a) = normal.gradient.segment<3>(layout.start(free[a]));
    for (std::size_t b = 0; b < free.size(); ++b) {
      if (!layout.adjacent(free[a], free[b])) continue;
      int row = free[a];
      const Place place = layout.place(free[a], free[b], &row);
      const Eigen::Map<const Matrix3, 0, Eigen::OuterStride<>> m(normal.hessian.data() + place.offset,
                                                                 Eigen::OuterStride<>(place.stride));
      out.hessian.block<3, 3>(3 * a, 3 * b) = row == free[a] ? Matrix3(m) : Matrix3(m.transpose());
    }
  }
  return out;
}

Matrix undamped_step(const Graph& graph, const Pose* poses) {
  const Layout& layout = graph.layout();
  NormalEquations normal(layout);
  graph.linearize(poses, Weighting::kIrls, normal);
  BlockCholesky cholesky(layout);
  const int failed = cholesky.factorize(normal.hessian, 0.0);
  if (failed >= 0) throw_undetermined(failed);
  Vector step = -normal.gradient;
  cholesky.solve(step);
  Matrix out = Matrix::Zero(layout.poses(), 3);
  for (int k = 0; k < layout.poses(); ++k)
    if (!layout.fixed(k)) out.row(k) = step.segment<3>(layout.start(k)).transpose();
  return out;
}

}  // namespace dgorl
