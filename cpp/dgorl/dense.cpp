#include "dgorl/dense.hpp"

#include <algorithm>
#include <cstring>

// Wider vectors where the machine has them. Multiplication and addition stay two roundings: the bits are the
// same.
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define DGORL_CLONES __attribute__((target_clones("avx2", "default")))
#else
#define DGORL_CLONES
#endif
#define DGORL_INLINE inline __attribute__((always_inline))

namespace dgorl {
namespace {

// Four doubles; where the machine's vectors are shorter the compiler takes several.
using Vector4 = double __attribute__((vector_size(32), aligned(8)));

constexpr int kHeight = 8, kWidth = 4;  // a tile: its accumulators fill half of the vector registers

// What a tile of c loses, summed in registers.
template <int Width>
DGORL_INLINE void tile(double* sum, const double* a, int a_stride, Strided b, int depth) {
  Vector4 s[Width][2] = {};
  for (int k = 0; k < depth; ++k, a += a_stride, b.data += b.row) {
    const Vector4 upper = *reinterpret_cast<const Vector4*>(a),
                  lower = *reinterpret_cast<const Vector4*>(a + 4);
    for (int j = 0; j < Width; ++j) {
      const double factor = b.data[j * b.column];
      s[j][0] += upper * factor;
      s[j][1] += lower * factor;
    }
  }
  std::memcpy(sum, s, sizeof s);
}

// The same where c has fewer rows than a tile.
DGORL_INLINE void low(double* sum, const double* a, int a_stride, Strided b, int rows, int depth) {
  for (int r = 0; r < rows; ++r) {
    sum[r] = 0.0;
    for (int k = 0; k < depth; ++k) sum[r] += a[k * a_stride + r] * b.data[k * b.row];
  }
}

}  // namespace

DGORL_CLONES
void subtract_product(double* c, int c_stride, const double* a, int a_stride, Strided b, int rows,
                      int columns, int depth, bool lower) {
  double sum[kWidth * kHeight];
  for (int j = 0, width; j < columns; j += width) {
    width = columns - j >= kWidth && rows >= kHeight ? kWidth : 1;
    const Strided right{b.data + j * b.column, b.row, b.column};
    for (int next = lower ? j - j % kHeight : 0; next < rows; next += kHeight) {
      const int r = std::max(0, std::min(next, rows - kHeight));  // the last tile overlaps the one before it
      if (rows < kHeight)
        low(sum, a, a_stride, right, rows, depth);
      else if (width == kWidth)
        tile<kWidth>(sum, a + r, a_stride, right, depth);
      else
        tile<1>(sum, a + r, a_stride, right, depth);
      const int end = std::min(r + kHeight, rows);
      for (int x = 0; x < width; ++x)
        for (int y = lower ? std::max(next, j + x) : next; y < end; ++y)
          c[(j + x) * c_stride + y] -= sum[x * kHeight + y - r];
    }
  }
}

}  // namespace dgorl
