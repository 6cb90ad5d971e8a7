#include "arguments.hpp"

#include <nanobind/stl/string.h>

#include <cstring>
#include <memory>

namespace dgorl::bindings {
namespace {

template <class T>
struct DType;
template <>
struct DType<double> {
  static constexpr const char *name = "float64", *kinds = "fiub";
};
template <>
struct DType<std::int64_t> {
  static constexpr const char *name = "int64", *kinds = "iu";
};
template <>
struct DType<bool> {
  static constexpr const char *name = "bool", *kinds = "b";
};

// Through numpy: lists, other dtypes, strides. Never a silent truncation, such as of 0.5 to an index.
template <class T>
nb::object convert(const std::string& name, nb::handle value) {
  const nb::module_ numpy = nb::module_::import_("numpy");
  try {
    nb::object array = numpy.attr("asarray")(value);
    const auto kind = nb::cast<std::string>(array.attr("dtype").attr("kind"));
    const bool empty = nb::cast<std::size_t>(array.attr("size")) == 0;
    if (!empty && std::strstr(DType<T>::kinds, kind.c_str()) == nullptr)
      throw std::invalid_argument(name + ": must be convertible to " + DType<T>::name);
    return numpy.attr("asarray")(array, DType<T>::name, "C");
  } catch (nb::python_error&) {
    throw std::invalid_argument(name + ": must be an array of " + DType<T>::name);
  }
}

std::string describe(const std::vector<nb::ssize_t>& shape) {
  std::string out = "(";
  for (std::size_t k = 0; k < shape.size(); ++k)
    out += (k ? ", " : "") + (shape[k] == kAny ? std::string("*") : std::to_string(shape[k]));
  return out + (shape.size() == 1 ? ",)" : ")");
}

template <class T>
nb::object own(std::vector<T> values, const std::vector<std::size_t>& shape) {
  auto holder = std::make_unique<std::vector<T>>(std::move(values));
  T* data = holder->data();
  nb::capsule owner(holder.release(), [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  static T none{};  // an empty vector may have no address
  return nb::cast(nb::ndarray<nb::numpy, T>(data ? data : &none, shape.size(), shape.data(), owner));
}

}  // namespace

template <class T>
Argument<T>::Argument(const std::string& name, nb::handle value, const std::vector<nb::ssize_t>& shape) {
  if (!nb::try_cast(value, array_, false)) {
    owner_ = convert<T>(name, value);
    if (!nb::try_cast(owner_, array_, false)) throw std::invalid_argument(name + ": must be an array");
  }
  bool same = array_.ndim() == shape.size();
  for (std::size_t k = 0; same && k < shape.size(); ++k)
    same = shape[k] == kAny || static_cast<nb::ssize_t>(array_.shape(k)) == shape[k];
  if (same) return;
  std::vector<nb::ssize_t> got;
  for (std::size_t k = 0; k < array_.ndim(); ++k) got.push_back(static_cast<nb::ssize_t>(array_.shape(k)));
  throw std::invalid_argument(name + ": must have shape " + describe(shape) + ", got " + describe(got));
}

template class Argument<double>;
template class Argument<std::int64_t>;
template class Argument<bool>;

nb::object to_numpy(std::vector<double> values, std::vector<std::size_t> shape) {
  return own(std::move(values), shape);
}

nb::object to_numpy(const Eigen::MatrixXd& matrix) {
  const auto rows = static_cast<std::size_t>(matrix.rows()), cols = static_cast<std::size_t>(matrix.cols());
  std::vector<double> values(rows * cols);
  for (std::size_t r = 0; r < rows; ++r)
    for (std::size_t c = 0; c < cols; ++c)
      values[r * cols + c] = matrix(static_cast<Eigen::Index>(r), static_cast<Eigen::Index>(c));
  return own(std::move(values), {rows, cols});
}

nb::object to_numpy(const Eigen::VectorXd& vector) {
  return own(std::vector<double>(vector.data(), vector.data() + vector.size()),
             {static_cast<std::size_t>(vector.size())});
}

nb::object to_numpy(std::vector<std::int64_t> values) {
  const std::size_t size = values.size();
  return own(std::move(values), {size});
}

}  // namespace dgorl::bindings
