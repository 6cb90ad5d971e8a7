#include "dgorl/places.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <numeric>

#include "dgorl/evidence.hpp"
#include "dgorl/optimize.hpp"

namespace dgorl {
namespace {

constexpr int kBearings = 32, kHeadings = 24;
constexpr double kQuantiles[] = {0.0,   -0.792, 0.792, -1.465,
                                 1.465, -0.366, 0.366};  // of N(0, 1), at (k + 1/2) / 7
constexpr std::size_t kFits = 24, kCompared = 8 * kFits;
constexpr double kNeighbourhood = 0.3, kTurn = 0.4;  // share of the distance; [rad]
constexpr double kSame = 3.0, kHopeless = 40.0;
const Options kCoarse{15, 1e-2, 1e-6};

std::vector<std::size_t> order_by(const std::vector<double>& key, bool descending) {
  std::vector<std::size_t> order(key.size());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
    return descending ? key[a] > key[b] : key[a] < key[b];
  });
  return order;
}

}  // namespace

std::vector<Pose> cold_particles(const std::vector<Anchor>& anchors) {
  std::vector<Pose> out;
  out.reserve(anchors.size() * kBearings * kHeadings);
  for (const Anchor& anchor : anchors)
    for (int b = 0; b < kBearings; ++b) {
      const double beta = 2.0 * kPi * (b + anchor.jitter_bearing) / kBearings;
      const Vector2 direction(std::cos(beta), std::sin(beta));
      for (int h = 0; h < kHeadings; ++h) {
        const double d = anchor.distance * std::exp(anchor.relative * kQuantiles[(b + 3 * h) % 7]);
        Pose pose(0.0, 0.0, wrap(2.0 * kPi * (h + anchor.jitter_heading) / kHeadings));
        const Vector2 place = anchor.a + d * direction - pose.rotate(anchor.b);
        pose.x = place.x();
        pose.y = place.y();
        out.push_back(pose);
      }
    }
  return out;
}

std::vector<Pose> region_of_interest(const std::vector<Pose>& particles, const std::vector<Annulus>& annuli) {
  std::vector<double> hits;
  for (const Pose& pose : particles) {
    int count = 0;
    for (const Annulus& ring : annuli) {
      const double d = std::sqrt((pose.transform(ring.b) - ring.a).squaredNorm() + ring.height_squared);
      count += d >= ring.low && d <= ring.high;
    }
    hits.push_back(count);
  }
  const std::vector<std::size_t> order = order_by(hits, true);
  std::size_t keep = 0;
  while (keep < order.size() && hits[order[keep]] == hits[order[0]]) ++keep;
  keep = std::max(keep, particles.size() / 8);
  std::vector<Pose> out;
  for (std::size_t k = 0; k < keep; ++k) out.push_back(particles[order[k]]);
  return out;
}

std::vector<Pose> diverse(const std::vector<Pose>& particles, const std::vector<double>& cost, double radius,
                          std::size_t limit) {
  std::vector<Pose> out;
  std::vector<std::size_t> order = order_by(cost, false);
  order.resize(std::min(order.size(), kCompared));
  for (std::size_t index : order) {
    if (out.size() == limit) break;
    const Pose& pose = particles[index];
    const bool taken = std::any_of(out.begin(), out.end(), [&](const Pose& other) {
      return (other.position() - pose.position()).squaredNorm() < radius * radius &&
             std::abs(wrap(other.theta - pose.theta)) < kTurn;
    });
    if (!taken) out.push_back(pose);
  }
  return out;
}

Places distinct(const Places& modes, std::size_t limit) {
  Places out;
  std::vector<Matrix3> information;
  for (std::size_t index : order_by(modes.mass, true)) {
    if (out.poses.size() == limit || !std::isfinite(modes.mass[index])) break;
    if (!out.mass.empty() && modes.mass[index] < out.mass[0] - kHopeless) break;
    const Pose& pose = modes.poses[index];
    bool same = false;
    for (std::size_t k = 0; k < out.poses.size() && !same; ++k) {
      const Vector2 p = out.poses[k].unrotate(pose.position() - out.poses[k].position());
      const Vector3 difference(p.x(), p.y(), wrap(pose.theta - out.poses[k].theta));
      same = difference.dot(information[k] * difference) <= kSame * kSame;
    }
    if (same) continue;
    out.poses.push_back(pose);
    out.mass.push_back(modes.mass[index]);
    out.covariance.push_back(modes.covariance[index]);
    information.push_back(modes.covariance[index].inverse());
  }
  return out;
}

Places find_places(const Graph& graph, const Graph& spread, const std::vector<Anchor>& anchors,
                   const std::vector<Annulus>& annuli, const std::vector<Pose>& warm, const Vector3& pi,
                   std::size_t limit) {
  std::vector<Pose> starts = warm;
  if (!anchors.empty()) {
    const std::vector<Pose> particles = region_of_interest(cold_particles(anchors), annuli);
    std::vector<double> cost;
    for (const Pose& particle : particles) {
      const Pose both[] = {Pose(), particle};
      cost.push_back(spread.cost(both));
    }
    for (const Pose& pose : diverse(particles, cost, kNeighbourhood * anchors.back().distance, kFits))
      starts.push_back(pose);
  }
  Places modes;
  Optimizer optimizer(graph);
  const Rows<3> weak(pi.data(), 1, 3);
  for (const Pose& start : starts) {
    std::vector<Pose> both{Pose(), start};
    const Result result = optimizer.run(both, kCoarse);
    const Evidence found = evidence(graph, both.data(), {1}, {1}, weak);
    modes.poses.push_back(both[1]);
    modes.mass.push_back(-result.cost - 0.5 * found.log_determinant);
    modes.covariance.push_back(found.covariance);
  }
  return distinct(modes, limit);
}

}  // namespace dgorl
