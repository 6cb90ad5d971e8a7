// Where each pose lives in the normal equations: free poses sorted by (slot, index), one block per occupied
// slot.
#pragma once

#include <cstdint>
#include <limits>
#include <vector>

#include "dgorl/arrays.hpp"

namespace dgorl {

constexpr int kNoBlock = std::numeric_limits<int>::max();

// A 3x3 sub-block of the stored matrix; offset < 0: not stored, a fixed pose is involved.
struct Place {
  int offset = -1;
  int stride = 0;
};

// One block column of the lower triangle: the diagonal block of a slot (size x size) with the coupling to the
// next slot (next x size) below it, column-major, `rows` = size + next.
struct Panel {
  int size = 0, rows = 0;
  int offset = 0;  // of the first value
  int start = 0;   // of the first variable in vectors
  std::int64_t slot = 0;
  std::vector<int> poses;
};

class Layout {
 public:
  Layout(const Indices& slots, const Flags& fixed);

  int poses() const { return static_cast<int>(block_.size()); }
  int variables() const { return variables_; }
  int values() const { return values_; }
  int blocks() const { return static_cast<int>(panels_.size()); }
  const Panel& panel(int block) const { return panels_[block]; }
  bool fixed(int pose) const { return block_[pose] == kNoBlock; }
  int block(int pose) const { return block_[pose]; }
  int column(int pose) const { return column_[pose]; }
  int start(int pose) const { return fixed(pose) ? -1 : panels_[block_[pose]].start + column_[pose]; }

  // The stored 3x3 block of two free poses in the same or adjacent blocks; its rows belong to `row_pose`.
  Place place(int pose_a, int pose_b, int* row_pose) const;
  bool adjacent(int pose_a, int pose_b) const;

  // The Cholesky factor of a coupling keeps the zeros left of a row's first entry: below an odometry-only
  // coupling half the work goes away. Row group = pose of the later slot.
  int first_column(int pose) const { return first_column_[pose]; }
  void couple(int pose_a, int pose_b);

 private:
  std::vector<Panel> panels_;
  std::vector<int> block_, column_, first_column_;
  int variables_ = 0, values_ = 0;
};

}  // namespace dgorl
