#include "dgorl/panel_cholesky.hpp"

#include <algorithm>
#include <cmath>

#include "dgorl/block_cholesky.hpp"
#include "dgorl/dense.hpp"

namespace dgorl {
namespace {

// c -= a b' for `Height` rows and 3 columns, all column-major; the tile stays in registers.
template <int Height>
inline void subtract_tile(double* c, int c_stride, const double* a, const double* b, int stride, int depth) {
  using Rows = Eigen::Matrix<double, Height, 1>;
  using Map = Eigen::Map<Rows>;
  Map out0(c), out1(c + c_stride), out2(c + 2 * c_stride);
  Rows c0 = out0, c1 = out1, c2 = out2;
  for (int k = 0; k < depth; ++k, a += stride, b += stride) {
    const Eigen::Map<const Rows> column(a);
    c0 -= column * b[0];
    c1 -= column * b[1];
    c2 -= column * b[2];
  }
  out0 = c0;
  out1 = c1;
  out2 = c2;
}

class PanelCholesky {
 public:
  PanelCholesky(const Layout& layout, int block, double* values)
      : layout_(layout),
        panel_(layout.panel(block)),
        next_(panel_.rows > panel_.size ? &layout.panel(block + 1) : nullptr),
        values_(values + panel_.offset),
        n_(panel_.size),
        rows_(panel_.rows) {}

  int run(const double* hessian, double damping) {
    hessian += panel_.offset;
    if (damping > 0.0)
      for (int k = 0; k < n_; ++k) values_[k * (rows_ + 1)] += damping * hessian[k * (rows_ + 1)];
    const int strip = n_ < kLargePanel ? n_ : kStrip;
    for (int from = 0; from < n_; from += strip) {
      const int to = std::min(from + strip, n_);
      for (int j = from; j < to; j += 3) {
        update_columns(j, from);
        const int failed = factorize_columns(j, hessian);
        if (failed >= 0) return failed;
      }
      if (to < n_) update_rest(from, to);
    }
    return -1;
  }

  // What the next slot's diagonal block loses: C C'.
  void update_next(double* values) {
    if (!next_) return;
    double* next = values + next_->offset;
    const int m = next_->size;
    if (m >= kLargePanel) {
      const double* coupling = values_ + n_;
      subtract_product(next, next_->rows, coupling, rows_, {coupling, rows_, 1}, m, m, n_, true);
      return;
    }
    for (int j = 0; j < m; j += 3)
      for (int r = j; r < m;) {
        const int height = r + 6 <= m ? 6 : 3;
        const int first = std::max(first_column(r, height), first_column(j, 3));
        subtract(height, next + j * next_->rows + r, next_->rows, n_ + r, n_ + j, first, n_);
        r += height;
      }
  }

 private:
  // The leftmost column of the coupling rows that is not structurally zero.
  int first_column(int row, int height) const {
    const int a = layout_.first_column(next_->poses[row / 3]);
    return height == 3 ? a : std::min(a, layout_.first_column(next_->poses[row / 3 + 1]));
  }

  void subtract(int height, double* c, int c_stride, int row_a, int row_b, int from, int to) const {
    if (from >= to) return;
    const double *a = values_ + from * rows_ + row_a, *b = values_ + from * rows_ + row_b;
    if (height == 6)
      subtract_tile<6>(c, c_stride, a, b, rows_, to - from);
    else
      subtract_tile<3>(c, c_stride, a, b, rows_, to - from);
  }

  // Columns j..j+2 less what the columns [from, j) contribute.
  void update_columns(int j, int from) const {
    double* column = values_ + j * rows_;
    for (int r = j; r < n_;) {
      const int height = r + 6 <= n_ ? 6 : 3;
      subtract(height, column + r, rows_, r, j, from, j);
      r += height;
    }
    for (int r = n_; r < rows_;) {
      const int height = r + 6 <= rows_ ? 6 : 3;
      subtract(height, column + r, rows_, r, j, std::max(from, first_column(r - n_, height)), j);
      r += height;
    }
  }

  // The 3x3 Cholesky at j and the columns below it. Returns -1 or the row of the vanishing pivot.
  int factorize_columns(int j, const double* hessian) const {
    for (int k = j; k < j + 3; ++k) {
      double* column = values_ + k * rows_;
      if (!(column[k] > kSingular * hessian[k * (rows_ + 1)])) return k;
      const double root = std::sqrt(column[k]), inverse = 1.0 / root;
      column[k] = root;
      Eigen::Map<Vector> below(column + k + 1, rows_ - k - 1);
      below *= inverse;
      for (int c = k + 1; c < j + 3; ++c)
        Eigen::Map<Vector>(values_ + c * rows_ + k + 1, rows_ - k - 1) -= column[c] * below;
    }
    return -1;
  }

  // Right-looking update of the columns after a strip of a large panel.
  void update_rest(int from, int to) const {
    const double *head = values_ + from * rows_ + to, *below = values_ + from * rows_ + n_;
    const Strided transposed{head, rows_, 1};
    subtract_product(values_ + to * rows_ + to, rows_, head, rows_, transposed, n_ - to, n_ - to, to - from,
                     true);
    subtract_product(values_ + to * rows_ + n_, rows_, below, rows_, transposed, rows_ - n_, n_ - to,
                     to - from);
  }

  const Layout& layout_;
  const Panel& panel_;
  const Panel* next_;
  double* values_;
  int n_, rows_;
};

}  // namespace

int factorize_panel(const Layout& layout, int block, const double* hessian, double damping, double* values) {
  PanelCholesky panel(layout, block, values);
  const int failed = panel.run(hessian, damping);
  if (failed < 0) panel.update_next(values);
  return failed;
}

}  // namespace dgorl
