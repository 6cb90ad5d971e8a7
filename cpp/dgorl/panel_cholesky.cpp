#include "dgorl/panel_cholesky.hpp"

#include <cmath>

#include "dgorl/block_cholesky.hpp"

namespace dgorl {

int factorize_panel(const Layout& layout, int block, const double* hessian, double damping, double* values) {
  const Panel& p = layout.panel(block);
  Eigen::Map<Matrix, 0, Eigen::OuterStride<>> panel(values + p.offset, p.rows, p.size,
                                                    Eigen::OuterStride<>(p.rows));
  for (int k = 0; k < p.size; ++k) {
    const double h = hessian[p.offset + k * p.rows + k];
    double pivot = panel(k, k) + damping * h;
    if (!(pivot > kSingular * h)) return k;
    pivot = std::sqrt(pivot);
    panel(k, k) = pivot;
    panel.col(k).tail(p.rows - k - 1) /= pivot;
    for (int j = k + 1; j < p.size; ++j)
      panel.col(j).tail(p.rows - j) -= panel.col(k).tail(p.rows - j) * panel(j, k);
  }
  if (p.rows > p.size) {
    const Panel& q = layout.panel(block + 1);
    Block next(values + q.offset, q.size, q.size, Eigen::OuterStride<>(q.rows));
    const auto coupling = panel.bottomRows(q.size);
    for (int k = 0; k < p.size; ++k)
      for (int j = 0; j < q.size; ++j)
        next.col(j).tail(q.size - j) -= coupling.col(k).tail(q.size - j) * coupling(j, k);
  }
  return -1;
}

}  // namespace dgorl
