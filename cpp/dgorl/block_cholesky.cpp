#include "dgorl/block_cholesky.hpp"

#include <Eigen/Cholesky>
#include <cmath>

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

int BlockCholesky::factorize(const Vector& hessian, double damping, int blocks) {
  values_ = hessian;
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
    auto head = x.middleRows(at, p.size);
    diagonal(b).triangularView<Eigen::Lower>().solveInPlace(head);
    if (p.rows > p.size) x.middleRows(at + p.size, p.rows - p.size).noalias() -= coupling(b) * head;
  }
}

void BlockCholesky::solve(Vector& x) const {
  for (int b = 0; b < layout_.blocks(); ++b) {
    const Panel& p = layout_.panel(b);
    const double* column = values_.data() + p.offset;
    double* head = x.data() + p.start;
    for (int k = 0; k < p.size; ++k, column += p.rows) {
      head[k] /= column[k];
      for (int r = k + 1; r < p.rows; ++r) head[r] -= column[r] * head[k];
    }
  }
  for (int b = layout_.blocks() - 1; b >= 0; --b) {
    const Panel& p = layout_.panel(b);
    double* head = x.data() + p.start;
    for (int k = p.size - 1; k >= 0; --k) {
      const double* column = values_.data() + p.offset + k * p.rows;
      double even = 0.0, odd = 0.0;
      int r = k + 1;
      for (; r + 1 < p.rows; r += 2) {
        even += column[r] * head[r];
        odd += column[r + 1] * head[r + 1];
      }
      if (r < p.rows) even += column[r] * head[r];
      head[k] = (head[k] - (even + odd)) / column[k];
    }
  }
}

}  // namespace dgorl
