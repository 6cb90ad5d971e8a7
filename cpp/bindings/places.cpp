// dgorl._core.find_places.
#include "dgorl/places.hpp"

#include "arguments.hpp"

using namespace nb::literals;

namespace dgorl::bindings {
namespace {

// Rows of Python arrays as the core's structs.
std::vector<Anchor> anchors_of(const Rows<8>& rows) {
  std::vector<Anchor> out;
  for (Eigen::Index k = 0; k < rows.rows(); ++k) {
    const auto r = rows.row(k);
    out.push_back({{r[0], r[1]}, {r[2], r[3]}, r[4], r[5], r[6], r[7]});
  }
  return out;
}

std::vector<Annulus> annuli_of(const Rows<7>& rows) {
  std::vector<Annulus> out;
  for (Eigen::Index k = 0; k < rows.rows(); ++k) {
    const auto r = rows.row(k);
    out.push_back({{r[0], r[1]}, {r[2], r[3]}, r[4] * r[4], r[5], r[6]});
  }
  return out;
}

void check_two(const Graph& graph, const char* name) {
  if (graph.layout().poses() != 2 || !graph.layout().fixed(0) || graph.layout().fixed(1))
    throw std::invalid_argument(std::string(name) + ": must be of two poses, the first one fixed");
}

void check_finite(const char* name, const double* data, Eigen::Index size) {
  if (!Eigen::Map<const Eigen::VectorXd>(data, size).allFinite())
    throw std::invalid_argument(std::string(name) + ": must be finite");
}

nb::tuple places(const Graph& graph, const Graph& spread, nb::handle anchors, nb::handle annuli,
                 nb::handle warm, nb::handle pi, nb::ssize_t limit) {
  check_two(graph, "graph");
  check_two(spread, "spread");
  if (limit < 1) throw std::invalid_argument("limit: must be at least 1");
  const RowArgument<8> anchor_rows("anchors", anchors);
  const RowArgument<7> annulus_rows("annuli", annuli);
  const RowArgument<3> warm_rows("warm", warm);
  const Argument<double> information("pi", pi, {3});
  check_finite("anchors", anchor_rows.data(), 8 * anchor_rows.rows());
  check_finite("annuli", annulus_rows.data(), 7 * annulus_rows.rows());
  check_finite("warm", warm_rows.data(), 3 * warm_rows.rows());
  std::vector<double> poses, covariance;
  Places found;
  {
    const nb::gil_scoped_release unlocked;
    std::vector<Pose> starts;
    for (Eigen::Index k = 0; k < warm_rows.rows(); ++k) starts.emplace_back(warm_rows.data() + 3 * k);
    found = find_places(graph, spread, anchors_of(anchor_rows), annuli_of(annulus_rows), starts,
                        Vector3(information.data()[0], information.data()[1], information.data()[2]),
                        static_cast<std::size_t>(limit));
    for (std::size_t k = 0; k < found.poses.size(); ++k) {
      poses.insert(poses.end(), {found.poses[k].x, found.poses[k].y, found.poses[k].theta});
      covariance.insert(covariance.end(), found.covariance[k].data(), found.covariance[k].data() + 9);
    }
  }
  const std::size_t count = found.poses.size();
  return nb::make_tuple(to_numpy(std::move(poses), {count, 3}), to_numpy(std::move(found.mass), {count}),
                        to_numpy(std::move(covariance), {count, 3, 3}));
}

}  // namespace

void bind_places(nb::module_& m) {
  m.def("find_places", &places, "graph"_a, "spread"_a, "anchors"_a, "annuli"_a, "warm"_a, "pi"_a, "limit"_a);
}

}  // namespace dgorl::bindings
