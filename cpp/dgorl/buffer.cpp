#include "dgorl/buffer.hpp"

#include <utility>

namespace dgorl {
namespace {

constexpr std::size_t kKept = 4;            // buffers; a solve uses three
constexpr std::size_t kLargest = 1u << 20;  // doubles; 8 MB, larger ones go back to the system

std::vector<std::vector<double>>& store() {
  static thread_local std::vector<std::vector<double>> buffers;
  return buffers;
}

}  // namespace

Buffer::Buffer(std::size_t size) {
  if (!store().empty()) {
    values_ = std::move(store().back());
    store().pop_back();
  }
  if (values_.capacity() < size) values_ = std::vector<double>();
  values_.resize(size);
}

Buffer::~Buffer() {
  if (values_.capacity() > 0 && values_.capacity() <= kLargest && store().size() < kKept)
    store().push_back(std::move(values_));
}

}  // namespace dgorl
