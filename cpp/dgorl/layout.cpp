#include "dgorl/layout.hpp"

#include <algorithm>
#include <cstdlib>
#include <map>
#include <stdexcept>
#include <string>

namespace dgorl {

Layout::Layout(const Indices& slots, const Flags& fixed) {
  if (slots.size() != fixed.size()) throw std::invalid_argument("fixed: must have one entry per slot");
  const int n = static_cast<int>(slots.size());
  block_.assign(n, kNoBlock);
  column_.assign(n, 0);
  first_column_.assign(n, 0);
  std::map<std::int64_t, std::vector<int>> by_slot;
  for (int k = 0; k < n; ++k) {
    if (slots[k] < (fixed[k] ? -1 : 0))
      throw std::invalid_argument("slots: must not be negative, -1 is for fixed poses (row " +
                                  std::to_string(k) + ")");
    if (!fixed[k]) by_slot[slots[k]].push_back(k);
  }
  for (auto& [slot, poses] : by_slot) {
    Panel panel;
    panel.size = 3 * static_cast<int>(poses.size());
    panel.start = variables_;
    panel.slot = slot;
    panel.poses = std::move(poses);
    for (std::size_t k = 0; k < panel.poses.size(); ++k) {
      block_[panel.poses[k]] = blocks();
      column_[panel.poses[k]] = 3 * static_cast<int>(k);
    }
    variables_ += panel.size;
    panels_.push_back(std::move(panel));
  }
  for (int b = 0; b < blocks(); ++b) {
    Panel& panel = panels_[b];
    panel.rows = panel.size + (b + 1 < blocks() ? panels_[b + 1].size : 0);
    panel.offset = values_;
    values_ += panel.rows * panel.size;
    if (b > 0)
      for (int pose : panel.poses) first_column_[pose] = panels_[b - 1].size;
  }
}

bool Layout::adjacent(int pose_a, int pose_b) const {
  return fixed(pose_a) || fixed(pose_b) || std::abs(block_[pose_a] - block_[pose_b]) <= 1;
}

Place Layout::place(int pose_a, int pose_b, int* row_pose) const {
  if (fixed(pose_a) || fixed(pose_b)) return {};
  const bool a_is_row =
      block_[pose_a] != block_[pose_b] ? block_[pose_a] > block_[pose_b] : column_[pose_a] >= column_[pose_b];
  const int row = a_is_row ? pose_a : pose_b, col = a_is_row ? pose_b : pose_a;
  if (row_pose) *row_pose = row;
  const Panel& panel = panels_[block_[col]];
  const int r = column_[row] + (block_[row] == block_[col] ? 0 : panel.size);
  return {panel.offset + column_[col] * panel.rows + r, panel.rows};
}

void Layout::couple(int pose_a, int pose_b) {
  if (fixed(pose_a) || fixed(pose_b) || block_[pose_a] == block_[pose_b]) return;
  const int row = block_[pose_a] > block_[pose_b] ? pose_a : pose_b, col = row == pose_a ? pose_b : pose_a;
  first_column_[row] = std::min(first_column_[row], column_[col]);
}

}  // namespace dgorl
