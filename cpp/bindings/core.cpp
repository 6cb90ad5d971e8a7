// dgorl._core: checks shapes and raises, nothing else. Documented in src/dgorl/_core.pyi.
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "arguments.hpp"
#include "dgorl/covariance.hpp"
#include "dgorl/evidence.hpp"
#include "dgorl/inspect.hpp"
#include "dgorl/marginalize.hpp"
#include "dgorl/motion.hpp"
#include "dgorl/optimize.hpp"

using namespace nb::literals;

namespace dgorl::bindings {
namespace {

void append(const std::vector<Pose>& poses, std::vector<double>& out) {
  for (const Pose& p : poses) out.insert(out.end(), {p.x, p.y, p.theta});
}

// Results with a batch axis; covariance is None where it was not asked for.
struct Solution {
  nb::object poses, cost, iterations, reason, covariance;
};

// The poses of one start of a batch.
std::vector<Pose> start(const Graph& graph, const Argument<double>& starts, std::size_t b, const char* name) {
  const std::size_t n = starts.extent(1);
  return graph.poses({starts.data() + 3 * n * b, static_cast<Eigen::Index>(n), 3}, name);
}

Solution optimize(const Graph& graph, nb::handle initial, int max_iterations, double step_tolerance,
                  double initial_damping) {
  const Options options{max_iterations, step_tolerance, initial_damping};
  check(options);
  const auto n = static_cast<std::size_t>(graph.layout().poses());
  const Argument<double> starts("initial", initial, {kAny, static_cast<nb::ssize_t>(n), 3});
  const std::size_t batch = starts.extent(0);
  std::vector<double> poses, cost;
  std::vector<std::int64_t> iterations;
  std::vector<std::string> reason;
  {
    const nb::gil_scoped_release unlocked;
    Optimizer optimizer(graph);
    poses.reserve(3 * n * batch);
    for (std::size_t b = 0; b < batch; ++b) {
      std::vector<Pose> x = start(graph, starts, b, "initial");
      const Result result = optimizer.run(x, options);
      append(x, poses);
      cost.push_back(result.cost);
      iterations.push_back(result.iterations);
      reason.emplace_back(name(result.reason));
    }
  }
  return {to_numpy(std::move(poses), {batch, n, 3}), to_numpy(std::move(cost), {batch}),
          to_numpy(std::move(iterations)), nb::cast(reason), nb::none()};
}

Solution solve(const Graph& graph, nb::handle initial, nb::handle select, int max_iterations,
               double step_tolerance, double initial_damping) {
  const Options options{max_iterations, step_tolerance, initial_damping};
  check(options);
  const RowArgument<3> start("initial", initial, graph.layout().poses());
  const std::vector<int> selected = checked_selection(graph.layout(), IndexArgument("select", select));
  std::vector<double> poses;
  Result result;
  Matrix covariance;
  {
    const nb::gil_scoped_release unlocked;
    Optimizer optimizer(graph);
    std::vector<Pose> x = graph.poses(start, "initial");
    result = optimizer.run(x, options);
    covariance = optimizer.covariance(x, selected);
    append(x, poses);
  }
  const auto n = static_cast<std::size_t>(graph.layout().poses());
  return {to_numpy(std::move(poses), {1, n, 3}), to_numpy(std::vector<double>{result.cost}, {1}),
          to_numpy(std::vector<std::int64_t>{result.iterations}),
          nb::cast(std::vector<std::string>{name(result.reason)}), to_numpy(covariance)};
}

nb::object covariance(const Graph& graph, nb::handle poses, nb::handle select) {
  const RowArgument<3> at("poses", poses, graph.layout().poses());
  const std::vector<int> selected = checked_selection(graph.layout(), IndexArgument("select", select));
  Matrix out;
  {
    const nb::gil_scoped_release unlocked;
    const std::vector<Pose> x = graph.poses(at, "poses");
    out = Optimizer(graph).covariance(x, selected);
  }
  return to_numpy(out);
}

nb::tuple marginalize_slots(const Graph& graph, nb::handle poses, std::int64_t slot) {
  const RowArgument<3> at("poses", poses, graph.layout().poses());
  Marginal out;
  {
    const nb::gil_scoped_release unlocked;
    const std::vector<Pose> x = graph.poses(at, "poses");
    out = marginalize(graph, x.data(), slot);
  }
  return nb::make_tuple(to_numpy(std::vector<std::int64_t>(out.kept.begin(), out.kept.end())),
                        to_numpy(out.information), to_numpy(out.gradient));
}

nb::object gauss_newton_step(const Graph& graph, nb::handle poses) {
  const std::vector<Pose> x = graph.poses(RowArgument<3>("poses", poses, graph.layout().poses()), "poses");
  return to_numpy(undamped_step(graph, x.data()));
}

nb::tuple hessian(const Graph& graph, nb::handle poses, bool exact) {
  const std::vector<Pose> x = graph.poses(RowArgument<3>("poses", poses, graph.layout().poses()), "poses");
  const DenseNormalEquations out =
      dense_normal_equations(graph, x.data(), exact ? Weighting::kNewton : Weighting::kIrls);
  return nb::make_tuple(to_numpy(out.hessian), to_numpy(out.gradient));
}

double cost(const Graph& graph, nb::handle poses) {
  const RowArgument<3> at("poses", poses, graph.layout().poses());
  return graph.cost(graph.poses(at, "poses").data());
}

nb::object costs(const Graph& graph, nb::handle poses) {
  const Argument<double> starts("poses", poses, {kAny, graph.layout().poses(), 3});
  std::vector<double> out;
  {
    const nb::gil_scoped_release unlocked;
    for (std::size_t b = 0; b < starts.extent(0); ++b)
      out.push_back(graph.cost(start(graph, starts, b, "poses").data()));
  }
  const std::size_t batch = out.size();
  return to_numpy(std::move(out), {batch});
}

nb::tuple evidence_of(const Graph& graph, nb::handle poses, nb::handle select, nb::handle soft,
                      nb::handle information) {
  const Argument<double> starts("poses", poses, {kAny, graph.layout().poses(), 3});
  const std::vector<int> selected = checked_selection(graph.layout(), IndexArgument("select", select));
  const std::vector<int> weak = checked_selection(graph.layout(), IndexArgument("soft", soft), "soft");
  const RowArgument<3> pi("information", information, static_cast<nb::ssize_t>(weak.size()));
  const std::size_t batch = starts.extent(0), m = 3 * selected.size();
  std::vector<double> determinants, covariances;
  {
    const nb::gil_scoped_release unlocked;
    for (std::size_t b = 0; b < batch; ++b) {
      const Evidence found = evidence(graph, start(graph, starts, b, "poses").data(), selected, weak, pi);
      determinants.push_back(found.log_determinant);
      covariances.insert(covariances.end(), found.covariance.data(), found.covariance.data() + m * m);
    }
  }
  return nb::make_tuple(to_numpy(std::move(determinants), {batch}),
                        to_numpy(std::move(covariances), {batch, m, m}));
}

nb::list residuals(const Graph& graph, nb::handle poses) {
  const RowArgument<3> at("poses", poses, graph.layout().poses());
  nb::list out;
  for (const Residuals& r : graph.residuals(graph.poses(at, "poses").data()))
    out.append(nb::make_tuple(r.kind, to_numpy(r.values)));
  return out;
}

nb::object chain_poses(nb::handle start, nb::handle deltas) {
  const Argument<double> first("start", start, {3});
  const auto out = chain(Pose(first.data()), RowArgument<3>("deltas", deltas));
  std::vector<double> values;
  for (const Vector3& v : out) values.insert(values.end(), v.data(), v.data() + 3);
  return to_numpy(std::move(values), {out.size(), 3});
}

}  // namespace

void bind_adders(nb::class_<Graph>& graph);
void bind_places(nb::module_& m);
void bind_tracks(nb::module_& m);

void bind(nb::module_& m) {
  m.attr("NONE") = static_cast<int>(KernelType::kNone);
  m.attr("HUBER") = static_cast<int>(KernelType::kHuber);
  m.attr("CAUCHY") = static_cast<int>(KernelType::kCauchy);
  m.attr("HUBER_NEGATIVE") = static_cast<int>(KernelType::kHuberNegative);
  m.attr("CAUCHY_NEGATIVE") = static_cast<int>(KernelType::kCauchyNegative);

  nb::class_<Solution>(m, "Solution")
      .def_ro("poses", &Solution::poses)
      .def_ro("cost", &Solution::cost)
      .def_ro("iterations", &Solution::iterations)
      .def_ro("reason", &Solution::reason)
      .def_ro("covariance", &Solution::covariance);

  nb::class_<Graph> graph(m, "Graph");
  graph.def(
      "__init__",
      [](Graph* self, nb::handle slots, nb::handle fixed) {
        new (self) Graph(IndexArgument("slots", slots), FlagArgument("fixed", fixed));
      },
      "slots"_a, "fixed"_a);
  bind_adders(graph);
  graph
      .def("optimize", &optimize, "initial"_a, "max_iterations"_a = 50, "step_tolerance"_a = 1e-9,
           "initial_damping"_a = 1e-6)
      .def("solve", &solve, "initial"_a, "select"_a, "max_iterations"_a = 50, "step_tolerance"_a = 1e-9,
           "initial_damping"_a = 1e-6)
      .def("cost", &cost, "poses"_a)
      .def("costs", &costs, "poses"_a)
      .def("evidence", &evidence_of, "poses"_a, "select"_a, "soft"_a, "information"_a)
      .def("residuals", &residuals, "poses"_a)
      .def("covariance", &covariance, "poses"_a, "select"_a)
      .def("marginalize", &marginalize_slots, "poses"_a, "slot"_a)
      .def("gauss_newton_step", &gauss_newton_step, "poses"_a)
      .def("hessian", &hessian, "poses"_a, "exact"_a = false);
  bind_places(m);
  bind_tracks(m);
  m.def("chain", &chain_poses, "start"_a, "deltas"_a);
}

}  // namespace dgorl::bindings

NB_MODULE(_core, m) {
  nb::set_leak_warnings(false);  // who still holds a graph when the interpreter ends has not leaked it
  dgorl::bindings::bind(m);
}
