// The large arrays of a solve, recycled between calls: asking the system for fresh memory every time costs as
// much as an iteration on a small team.
#pragma once

#include <cstddef>
#include <vector>

namespace dgorl {

// Some doubles of undefined value. The memory comes from, and goes back to, a small store of this thread.
class Buffer {
 public:
  explicit Buffer(std::size_t size);
  ~Buffer();
  Buffer(Buffer&&) noexcept = default;
  Buffer& operator=(Buffer&&) noexcept = default;

  double* data() { return values_.data(); }
  const double* data() const { return values_.data(); }
  std::size_t size() const { return values_.size(); }

 private:
  std::vector<double> values_;
};

}  // namespace dgorl
