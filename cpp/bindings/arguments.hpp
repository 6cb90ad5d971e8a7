// NumPy arguments: any array-like of the right shape becomes a view of contiguous data; the rest is refused.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>
#include <string>
#include <vector>

#include "dgorl/arrays.hpp"

namespace nb = nanobind;

namespace dgorl::bindings {

constexpr nb::ssize_t kAny = -1;

// An argument kept alive while it is used; shape entries of kAny are free.
template <class T>
class Argument {
 public:
  Argument(const std::string& name, nb::handle value, const std::vector<nb::ssize_t>& shape);

  const T* data() const { return array_.data(); }
  nb::ssize_t rows() const { return static_cast<nb::ssize_t>(array_.shape(0)); }
  std::size_t extent(std::size_t axis) const { return array_.shape(axis); }

 private:
  nb::object owner_;
  nb::ndarray<const T, nb::c_contig, nb::device::cpu> array_;
};

extern template class Argument<double>;
extern template class Argument<std::int64_t>;
extern template class Argument<bool>;

struct IndexArgument : Argument<std::int64_t> {
  IndexArgument(const std::string& name, nb::handle value) : Argument(name, value, {kAny}) {}
  operator Indices() const { return {data(), rows()}; }
};

struct FlagArgument : Argument<bool> {
  FlagArgument(const std::string& name, nb::handle value) : Argument(name, value, {kAny}) {}
  operator Flags() const { return {data(), rows()}; }
};

template <int Columns>
struct RowArgument : Argument<double> {
  RowArgument(const std::string& name, nb::handle value, nb::ssize_t rows = kAny)
      : Argument(name, value, shape(rows)) {}
  operator Rows<Columns>() const { return {data(), this->rows(), Columns}; }

 private:
  static std::vector<nb::ssize_t> shape(nb::ssize_t rows) {
    if constexpr (Columns == 1) return {rows};
    if constexpr (Columns == 9) return {rows, 3, 3};
    return {rows, Columns};
  }
};

// Arrays for the caller.
nb::object to_numpy(std::vector<double> values, std::vector<std::size_t> shape);
nb::object to_numpy(const Eigen::MatrixXd& matrix);
nb::object to_numpy(const Eigen::VectorXd& vector);
nb::object to_numpy(std::vector<std::int64_t> values);

}  // namespace dgorl::bindings
