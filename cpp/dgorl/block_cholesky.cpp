#include "dgorl/block_cholesky.hpp"

#include <algorithm>

#include "dgorl/dense.hpp"
#include "dgorl/panel_cholesky.hpp"

namespace dgorl {

ConstBlock BlockCholesky::diagonal(int block) const {
  const Panel& p = layout_.panel(block);
  return {values_.data() + p.offset, p.size, p.size, Eigen::OuterStride<>(p.rows)};
}

ConstBlock BlockCholesky::coupling(int block) const {
  const Panel& p = layout_.panel(block);
  return {values_.data() + p.offset + p.size, p.rows - p.size, p.size, Eigen::OuterStride<>(p.rows)};
}

int BlockCholesky::factorize(const Buffer& hessian, double damping, int blocks) {
  std::copy_n(hessian.data(), hessian.size(), values_.data());
  for (int b = 0; b < blocks; ++b) {
    const Panel& p = layout_.panel(b);
    const int failed = factorize_panel(layout_, b, hessian.data(), damping, values_.data());
    if (failed >= 0) return p.poses[failed / 3];
  }
  return -1;
}

void BlockCholesky::forward(Eigen::Ref<Matrix> x, int first, int last) const {
  for (int b = first; b < last; ++b) {
    const Panel& p = layout_.panel(b);
    const int at = p.start - layout_.panel(first).start;
    if (p.size >= kLargePanel && x.cols() > 1) {
      forward_large(b, x, at);
      continue;
    }
    auto head = x.middleRows(at, p.size);
    diagonal(b).triangularView<Eigen::Lower>().solveInPlace(head);
    if (p.rows > p.size) x.middleRows(at + p.size, p.rows - p.size).noalias() -= coupling(b) * head;
  }
}

void BlockCholesky::forward_large(int block, Eigen::Ref<Matrix> x, int at) const {
  const Panel& p = layout_.panel(block);
  const int stride = static_cast<int>(x.outerStride()), columns = static_cast<int>(x.cols());
  for (int from = 0; from < p.size; from += kStrip) {
    const int to = std::min(from + kStrip, p.size);
    const double* strip = values_.data() + p.offset + from * p.rows;
    const ConstBlock corner(strip + from, to - from, to - from, Eigen::OuterStride<>(p.rows));
    auto head = x.middleRows(at + from, to - from);
    corner.triangularView<Eigen::Lower>().solveInPlace(head);
    subtract_product(x.data() + at + to, stride, strip + to, p.rows, {head.data(), 1, stride}, p.rows - to,
                     columns, to - from);
  }
}

void BlockCholesky::solve(Vector& x) const {
  using Column = Eigen::Map<const Vector>;
  for (int b = 0; b < layout_.blocks(); ++b) {
    const Panel& p = layout_.panel(b);
    const double* column = values_.data() + p.offset;
    for (int k = 0; k < p.size; ++k, column += p.rows) {
      const int below = p.rows - k - 1, at = p.start + k;
      const double xk = x[at] /= column[k];
      x.segment(at + 1, below).noalias() -= xk * Column(column + k + 1, below);
    }
  }
  for (int b = layout_.blocks() - 1; b >= 0; --b) {
    const Panel& p = layout_.panel(b);
    for (int k = p.size - 1; k >= 0; --k) {
      const double* column = values_.data() + p.offset + k * p.rows;
      const int below = p.rows - k - 1, at = p.start + k;
      x[at] = (x[at] - Column(column + k + 1, below).dot(x.segment(at + 1, below))) / column[k];
    }
  }
}

}  // namespace dgorl
