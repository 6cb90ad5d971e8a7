// Graph.add_*: one call per family of factors, arrays with one row per factor.
#include "arguments.hpp"
#include "dgorl/graph.hpp"

using namespace nb::literals;

namespace dgorl::bindings {
namespace {

Kernel kernel(int type, double width) { return {static_cast<KernelType>(type), width}; }

// The arguments of one call: named "family.argument" in errors, all with one row per factor.
struct Family {
  std::string prefix;
  nb::ssize_t count;

  std::string name(const char* argument) const { return prefix + "." + argument; }
  template <int Columns>
  RowArgument<Columns> rows(const char* argument, nb::handle value) const {
    return {name(argument), value, count};
  }
  IndexArgument indices(const char* argument, nb::handle value) const { return {name(argument), value}; }
};

Family family(const char* prefix, const char* argument, nb::handle indices) {
  const std::string name = std::string(prefix) + "." + argument;
  return {prefix, IndexArgument(name, indices).rows()};
}

void add_relative_poses(Graph& graph, nb::handle i, nb::handle j, nb::handle at_i, nb::handle at_j,
                        nb::handle delta, nb::handle information, int type, double width) {
  const Family f = family("relative_poses", "i", i);
  graph.add_relative_poses(f.indices("i", i), f.indices("j", j), f.rows<3>("at_i", at_i),
                           f.rows<3>("at_j", at_j), f.rows<3>("delta", delta),
                           f.rows<9>("information", information), kernel(type, width));
}

void add_odometry(Graph& graph, nb::handle i, nb::handle j, nb::handle delta, nb::handle information) {
  const Family f = family("odometry", "i", i);
  graph.add_odometry(f.indices("i", i), f.indices("j", j), f.rows<3>("delta", delta),
                     f.rows<9>("information", information));
}

void add_ranges(Graph& graph, nb::handle i, nb::handle j, nb::handle at_i, nb::handle at_j, nb::handle height,
                nb::handle range, nb::handle sigma, int type, double width) {
  const Family f = family("ranges", "i", i);
  graph.add_ranges(f.indices("i", i), f.indices("j", j), f.rows<2>("at_i", at_i), f.rows<2>("at_j", at_j),
                   f.rows<1>("height", height), f.rows<1>("range", range), f.rows<1>("sigma", sigma),
                   kernel(type, width));
}

void add_rssi(Graph& graph, nb::handle i, nb::handle j, nb::handle at_i, nb::handle at_j, nb::handle height,
              nb::handle rssi, nb::handle rssi_at_1m, nb::handle exponent, nb::handle sigma, int type,
              double width) {
  const Family f = family("rssi", "i", i);
  graph.add_rssi(f.indices("i", i), f.indices("j", j), f.rows<2>("at_i", at_i), f.rows<2>("at_j", at_j),
                 f.rows<1>("height", height), f.rows<1>("rssi", rssi), f.rows<1>("rssi_at_1m", rssi_at_1m),
                 f.rows<1>("exponent", exponent), f.rows<1>("sigma", sigma), kernel(type, width));
}

void add_bearings(Graph& graph, nb::handle observer, nb::handle target, nb::handle at_observer,
                  nb::handle at_target, nb::handle bearing, nb::handle sigma, int type, double width) {
  const Family f = family("bearings", "observer", observer);
  graph.add_bearings(f.indices("observer", observer), f.indices("target", target),
                     f.rows<3>("at_observer", at_observer), f.rows<2>("at_target", at_target),
                     f.rows<1>("bearing", bearing), f.rows<1>("sigma", sigma), kernel(type, width));
}

void add_prior(Graph& graph, std::int64_t reference, nb::handle members, nb::handle relative,
               nb::handle information, nb::handle gradient) {
  const Family f = family("prior", "members", members);
  const nb::ssize_t m = 3 * f.count;
  const Argument<double> h(f.name("information"), information, {m, m});
  graph.add_prior(reference, f.indices("members", members), f.rows<3>("relative", relative),
                  Square(h.data(), m, m), RowArgument<1>(f.name("gradient"), gradient, m));
}

}  // namespace

void bind_adders(nb::class_<Graph>& graph) {
  constexpr int none = static_cast<int>(KernelType::kNone);
  graph
      .def("add_relative_poses", &add_relative_poses, "i"_a, "j"_a, "at_i"_a, "at_j"_a, "delta"_a,
           "information"_a, "kernel"_a = none, "width"_a = 1.0)
      .def("add_odometry", &add_odometry, "i"_a, "j"_a, "delta"_a, "information"_a)
      .def("add_ranges", &add_ranges, "i"_a, "j"_a, "at_i"_a, "at_j"_a, "height"_a, "range"_a, "sigma"_a,
           "kernel"_a = none, "width"_a = 1.0)
      .def("add_rssi", &add_rssi, "i"_a, "j"_a, "at_i"_a, "at_j"_a, "height"_a, "rssi"_a, "rssi_at_1m"_a,
           "exponent"_a, "sigma"_a, "kernel"_a = none, "width"_a = 1.0)
      .def("add_bearings", &add_bearings, "observer"_a, "target"_a, "at_observer"_a, "at_target"_a,
           "bearing"_a, "sigma"_a, "kernel"_a = none, "width"_a = 1.0)
      .def("add_prior", &add_prior, "reference"_a, "members"_a, "relative"_a, "information"_a, "gradient"_a);
}

}  // namespace dgorl::bindings
