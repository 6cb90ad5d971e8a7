// Graph::add_*: checks the values of every argument, then stores the factors.
#include <Eigen/Cholesky>
#include <cmath>
#include <set>
#include <stdexcept>

#include "dgorl/graph.hpp"

namespace dgorl {
namespace {

[[noreturn]] void refuse(const std::string& name, const std::string& what, Eigen::Index row = -1) {
  throw std::invalid_argument(name + ": " + what + (row < 0 ? "" : " (row " + std::to_string(row) + ")"));
}

// The arguments of one call; all checks name them as "ranges.sigma".
class Arguments {
 public:
  Arguments(const Layout& layout, std::string family, Eigen::Index count)
      : layout_(layout), family_(std::move(family)), count_(count) {}

  std::string name(const char* argument) const { return family_ + "." + argument; }

  template <class Array>
  void finite(const char* argument, const Array& values) const {
    if (values.rows() != count_) refuse(name(argument), "must have " + std::to_string(count_) + " rows");
    if (values.allFinite()) return;
    for (Eigen::Index k = 0; k < values.rows(); ++k)
      if (!values.row(k).allFinite()) refuse(name(argument), "must be finite", k);
  }

  void positive(const char* argument, const Column& values) const {
    finite(argument, values);
    for (Eigen::Index k = 0; k < count_; ++k)
      if (values[k] <= 0.0) refuse(name(argument), "must be positive", k);
  }

  void kernel(const Kernel& kernel, bool scalar) const {
    const int type = static_cast<int>(kernel.type);
    if (type < 0 || type > static_cast<int>(KernelType::kCauchyNegative))
      refuse(name("kernel"), "must be one of NONE, HUBER, CAUCHY, HUBER_NEGATIVE, CAUCHY_NEGATIVE");
    if (!scalar && kernel.one_sided()) refuse(name("kernel"), "one-sided kernels are for scalar factors");
    if (!(kernel.width > 0.0) || !std::isfinite(kernel.width)) refuse(name("width"), "must be positive");
  }

  int pose(const char* argument, std::int64_t index, Eigen::Index row) const {
    if (index < 0 || index >= layout_.poses())
      refuse(name(argument), "must be a pose index below " + std::to_string(layout_.poses()), row);
    return static_cast<int>(index);
  }

  void poses(const char* name_i, const char* name_j, const Indices& i, const Indices& j) const {
    if (i.size() != count_) refuse(name(name_i), "must have " + std::to_string(count_) + " rows");
    if (j.size() != count_) refuse(name(name_j), "must have " + std::to_string(count_) + " rows");
    for (Eigen::Index k = 0; k < count_; ++k) {
      const int a = pose(name_i, i[k], k), b = pose(name_j, j[k], k);
      if (a == b) refuse(name(name_j), std::string("must differ from ") + name_i, k);
      if (!layout_.adjacent(a, b))
        refuse(name(name_j),
               std::string("must be in the slot of ") + name_i + " or the adjacent occupied one", k);
    }
  }

 private:
  const Layout& layout_;
  std::string family_;
  Eigen::Index count_;
};

template <class Derived>
bool symmetric(const Eigen::MatrixBase<Derived>& m) {
  return (m - m.transpose()).cwiseAbs().maxCoeff() <= 1e-9 * m.cwiseAbs().maxCoeff();
}

// U with U'U = information, upper triangular; a semi-definite matrix gives zero rows. False: indefinite.
bool upper_root(const Matrix3& information, Matrix3* root) {
  Matrix3 rest = information;
  root->setZero();
  for (int k = 0; k < 3; ++k) {
    const double h = information(k, k), tiny = 1e-13 * h;
    if (rest(k, k) > tiny) {
      root->row(k).tail(3 - k) = rest.row(k).tail(3 - k) / std::sqrt(rest(k, k));
      rest -= root->row(k).transpose() * root->row(k);
      continue;
    }
    if (h < 0.0 || rest(k, k) < -tiny) return false;
    for (int c = k + 1; c < 3; ++c)  // its row has to vanish with the pivot
      if (std::abs(rest(k, c)) > 1e-6 * std::sqrt(h * std::abs(information(c, c)))) return false;
  }
  return true;
}

Matrix3 checked_root(const Arguments& arguments, const Rows<9>& information, Eigen::Index k) {
  Matrix3 m = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(information.data() + 9 * k);
  if (!symmetric(m)) refuse(arguments.name("information"), "must be symmetric", k);
  m = (0.5 * (m + m.transpose())).eval();
  Matrix3 root;
  if (!upper_root(m, &root)) refuse(arguments.name("information"), "must be positive semi-definite", k);
  return root;
}

template <class Factor>
void store(Layout& layout, const Indices& i, const Indices& j, Group<Factor> group,
           std::vector<AnyGroup>& groups) {
  group.edges.reserve(group.factors.size());
  for (Eigen::Index k = 0; k < i.size(); ++k) {
    const int a = static_cast<int>(i[k]), b = static_cast<int>(j[k]);
    group.edges.emplace_back(layout, a, b);
    layout.couple(a, b);
  }
  groups.push_back(std::move(group));
}

template <class Factor>
Group<Factor> empty_group(Eigen::Index count, Kernel kernel) {
  Group<Factor> group;
  group.kernel = kernel;
  group.factors.reserve(count);
  return group;
}

}  // namespace

void Graph::add_relative_poses(const Indices& i, const Indices& j, const Rows<3>& at_i, const Rows<3>& at_j,
                               const Rows<3>& delta, const Rows<9>& information, Kernel kernel) {
  const Arguments arguments(layout_, "relative_poses", i.size());
  arguments.poses("i", "j", i, j);
  arguments.finite("at_i", at_i);
  arguments.finite("at_j", at_j);
  arguments.finite("delta", delta);
  arguments.finite("information", information);
  arguments.kernel(kernel, false);
  auto group = empty_group<RelativePose>(i.size(), kernel);
  for (Eigen::Index k = 0; k < i.size(); ++k)
    group.factors.emplace_back(Pose(at_i.data() + 3 * k), Pose(at_j.data() + 3 * k),
                               Pose(delta.data() + 3 * k), checked_root(arguments, information, k));
  store(layout_, i, j, std::move(group), groups_);
}

void Graph::add_odometry(const Indices& i, const Indices& j, const Rows<3>& delta,
                         const Rows<9>& information) {
  const Arguments arguments(layout_, "odometry", i.size());
  arguments.poses("i", "j", i, j);
  arguments.finite("delta", delta);
  arguments.finite("information", information);
  auto group = empty_group<RelativePose>(i.size(), {});
  for (Eigen::Index k = 0; k < i.size(); ++k)
    group.factors.emplace_back(Pose(), Pose(), Pose(delta.data() + 3 * k),
                               checked_root(arguments, information, k));
  store(layout_, i, j, std::move(group), groups_);
}

void Graph::add_ranges(const Indices& i, const Indices& j, const Rows<2>& at_i, const Rows<2>& at_j,
                       const Column& height, const Column& range, const Column& sigma, Kernel kernel) {
  const Arguments arguments(layout_, "ranges", i.size());
  arguments.poses("i", "j", i, j);
  arguments.finite("at_i", at_i);
  arguments.finite("at_j", at_j);
  arguments.finite("height", height);
  arguments.finite("range", range);
  arguments.positive("sigma", sigma);
  arguments.kernel(kernel, true);
  auto group = empty_group<Range>(i.size(), kernel);
  for (Eigen::Index k = 0; k < i.size(); ++k)
    group.factors.push_back({at_i.row(k), at_j.row(k), height[k] * height[k], range[k], 1.0 / sigma[k]});
  store(layout_, i, j, std::move(group), groups_);
}

void Graph::add_rssi(const Indices& i, const Indices& j, const Rows<2>& at_i, const Rows<2>& at_j,
                     const Column& height, const Column& rssi, const Column& rssi_at_1m,
                     const Column& exponent, const Column& sigma, Kernel kernel) {
  const Arguments arguments(layout_, "rssi", i.size());
  arguments.poses("i", "j", i, j);
  arguments.finite("at_i", at_i);
  arguments.finite("at_j", at_j);
  arguments.finite("height", height);
  arguments.finite("rssi", rssi);
  arguments.finite("rssi_at_1m", rssi_at_1m);
  arguments.positive("exponent", exponent);
  arguments.positive("sigma", sigma);
  arguments.kernel(kernel, true);
  auto group = empty_group<Rssi>(i.size(), kernel);
  for (Eigen::Index k = 0; k < i.size(); ++k)
    group.factors.push_back({at_i.row(k), at_j.row(k), height[k] * height[k], rssi[k] - rssi_at_1m[k],
                             10.0 * exponent[k] / std::log(10.0), 1.0 / sigma[k]});
  store(layout_, i, j, std::move(group), groups_);
}

void Graph::add_bearings(const Indices& observer, const Indices& target, const Rows<3>& at_observer,
                         const Rows<2>& at_target, const Column& bearing, const Column& sigma,
                         Kernel kernel) {
  const Arguments arguments(layout_, "bearings", observer.size());
  arguments.poses("observer", "target", observer, target);
  arguments.finite("at_observer", at_observer);
  arguments.finite("at_target", at_target);
  arguments.finite("bearing", bearing);
  arguments.positive("sigma", sigma);
  arguments.kernel(kernel, true);
  auto group = empty_group<Bearing>(observer.size(), kernel);
  for (Eigen::Index k = 0; k < observer.size(); ++k)
    group.factors.push_back(
        {at_observer.row(k).head<2>(), at_target.row(k), at_observer(k, 2) + bearing[k], 1.0 / sigma[k]});
  store(layout_, observer, target, std::move(group), groups_);
}

void Graph::add_prior(std::int64_t reference, const Indices& members, const Rows<3>& relative,
                      const Square& information, const Column& gradient) {
  const Eigen::Index m = members.size();
  const Arguments arguments(layout_, "prior", m);
  if (m == 0) refuse("prior.members", "must not be empty");
  if (reference != -1) arguments.pose("reference", reference, -1);
  std::set<int> all;
  if (reference >= 0) all.insert(static_cast<int>(reference));
  std::vector<int> list;
  for (Eigen::Index k = 0; k < m; ++k) {
    list.push_back(arguments.pose("members", members[k], k));
    if (!all.insert(list.back()).second) refuse("prior.members", "must differ from one another", k);
  }
  for (int a : all)
    for (int b : all)
      if (!layout_.adjacent(a, b))
        refuse("prior.members", "must be in one slot or two adjacent occupied ones");
  arguments.finite("relative", relative);
  const Arguments dense(layout_, "prior", 3 * m);
  dense.finite("information", information);
  dense.finite("gradient", gradient);
  if (!symmetric(information)) refuse("prior.information", "must be symmetric");
  std::vector<Pose> z;
  for (Eigen::Index k = 0; k < m; ++k) z.emplace_back(relative.data() + 3 * k);
  for (int a : all)
    for (int b : all) layout_.couple(a, b);
  groups_.emplace_back(Prior(layout_, static_cast<int>(reference), std::move(list), std::move(z),
                             0.5 * (information + information.transpose()), gradient));
}

std::vector<Pose> Graph::poses(const Rows<3>& rows, const char* name) const {
  const Eigen::Index n = layout_.poses();
  if (rows.rows() != n) refuse(name, "must have one row per pose, " + std::to_string(n));
  std::vector<Pose> out;
  out.reserve(n);
  for (Eigen::Index k = 0; k < n; ++k) {
    if (!rows.row(k).allFinite()) refuse(name, "must be finite", k);
    out.emplace_back(rows(k, 0), rows(k, 1), rows(k, 2));
  }
  return out;
}

}  // namespace dgorl
