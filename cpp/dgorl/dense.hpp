// Products of the large panels that many robots make, in tiles the compiler turns into vector instructions.
#pragma once

namespace dgorl {

// A matrix in memory: entry (r, c) is at data[r * row + c * column].
struct Strided {
  const double* data;
  int row, column;
};

// c -= a b, c (rows x columns) and a (rows x depth) column-major, b (depth x columns). With `lower` only
// entries (r, c), r >= c, are written. Every entry sums over depth in order, so all machines get the same
// bits.
void subtract_product(double* c, int c_stride, const double* a, int a_stride, Strided b, int rows,
                      int columns, int depth, bool lower = false);

}  // namespace dgorl
