// Cholesky factorisation of a block-tridiagonal matrix along the occupied slots, oldest first. Forward in
// time because then marginalising the oldest slots is the first part of it and the newest covariances are its
// tail.
#pragma once

#include "dgorl/buffer.hpp"
#include "dgorl/layout.hpp"

namespace dgorl {

using Vector = Eigen::VectorXd;
using Matrix = Eigen::MatrixXd;
using Block = Eigen::Map<Matrix, 0, Eigen::OuterStride<>>;
using ConstBlock = Eigen::Map<const Matrix, 0, Eigen::OuterStride<>>;

class BlockCholesky {
 public:
  explicit BlockCholesky(const Layout& layout) : layout_(layout), values_(layout.values()) {}

  // L L' = H + damping diag(H) for the first `blocks` blocks; what follows them gets their Schur complement.
  // Returns -1, or the pose whose variables are undetermined.
  int factorize(const Buffer& hessian, double damping, int blocks);
  int factorize(const Buffer& hessian, double damping) {
    return factorize(hessian, damping, layout_.blocks());
  }

  // In place: y = L^-1 x over blocks [first, last); the block after them gets what they leave of it.
  // x starts at block `first`.
  void forward(Eigen::Ref<Matrix> x, int first, int last) const;
  void forward(Eigen::Ref<Matrix> x, int first) const { forward(x, first, layout_.blocks()); }
  void solve(Vector& x) const;

  ConstBlock diagonal(int block) const;
  ConstBlock coupling(int block) const;

 private:
  // One block of forward() by strips, where it is large; its part of x starts at row `at`.
  void forward_large(int block, Eigen::Ref<Matrix> x, int at) const;

  const Layout& layout_;
  Buffer values_;
};

}  // namespace dgorl
