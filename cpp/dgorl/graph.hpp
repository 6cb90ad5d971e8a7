// The window graph: poses on time slots, factors between them, and its linearisation. METHOD section 1.
#pragma once

#include <string>
#include <variant>
#include <vector>

#include "dgorl/normal_equations.hpp"
#include "dgorl/prior.hpp"

namespace dgorl {

// Factors added in one call: one kind, one kernel.
template <class Factor>
struct Group {
  std::vector<Factor> factors;
  std::vector<Edge> edges;
  Kernel kernel;
};

using AnyGroup = std::variant<Group<RelativePose>, Group<Range>, Group<Rssi>, Group<Bearing>, Prior>;

struct Residuals {
  std::string kind;
  Matrix values;  // one row per factor; of a prior: delta, one row per member
};

class Graph {
 public:
  Graph(const Indices& slots, const Flags& fixed) : layout_(slots, fixed) {}
  Graph(const Graph&) = delete;  // priors point at the layout
  Graph& operator=(const Graph&) = delete;

  // All of them throw std::invalid_argument naming the argument and the row.
  void add_relative_poses(const Indices& i, const Indices& j, const Rows<3>& at_i, const Rows<3>& at_j,
                          const Rows<3>& delta, const Rows<9>& information, Kernel kernel);
  void add_odometry(const Indices& i, const Indices& j, const Rows<3>& delta, const Rows<9>& information);
  void add_ranges(const Indices& i, const Indices& j, const Rows<2>& at_i, const Rows<2>& at_j,
                  const Column& height, const Column& range, const Column& sigma, Kernel kernel);
  void add_rssi(const Indices& i, const Indices& j, const Rows<2>& at_i, const Rows<2>& at_j,
                const Column& height, const Column& rssi, const Column& rssi_at_1m, const Column& exponent,
                const Column& sigma, Kernel kernel);
  void add_bearings(const Indices& observer, const Indices& target, const Rows<3>& at_observer,
                    const Rows<2>& at_target, const Column& bearing, const Column& sigma, Kernel kernel);
  void add_prior(std::int64_t reference, const Indices& members, const Rows<3>& relative,
                 const Square& information, const Column& gradient);

  const Layout& layout() const { return layout_; }
  std::vector<Pose> poses(const Rows<3>& rows, const char* name) const;

  double cost(const Pose* poses) const;
  std::vector<Residuals> residuals(const Pose* poses) const;

  // With factors that touch one of the first `blocks` blocks only; kNoBlock: all, cost of fixed pairs
  // included.
  void linearize(const Pose* poses, Weighting weighting, NormalEquations& normal,
                 int blocks = kNoBlock) const;

  // Free poses in or after `block` touched by the factors that touch an earlier one, ascending.
  std::vector<int> touched(int block) const;

 private:
  Layout layout_;
  std::vector<AnyGroup> groups_;
};

}  // namespace dgorl
