// Where a rigid body may stand relative to another: particles, the region where the ranges meet, local fits.
// METHOD section 4.
#pragma once

#include <vector>

#include "dgorl/graph.hpp"

namespace dgorl {

// A reading of the distance between point a of the fixed body and point b of the free one, which particles
// are drawn round: d exp(relative N). The jitter in [0, 1) shifts their grid of bearings and headings.
struct Anchor {
  Vector2 a, b;
  double distance, relative, jitter_bearing, jitter_heading;
};

// A reading says that the distance is between low and high.
struct Annulus {
  Vector2 a, b;
  double height_squared, low, high;
};

struct Places {
  std::vector<Pose> poses;  // T_a_b, best first
  std::vector<double> mass;
  std::vector<Matrix3> covariance;
};

// Poses on the rings of the anchors, bearing and heading uniform, distance stratified.
std::vector<Pose> cold_particles(const std::vector<Anchor>& anchors);

// Those in every annulus or, where fewer than an eighth are, those that miss the fewest, in the given order.
std::vector<Pose> region_of_interest(const std::vector<Pose>& particles, const std::vector<Annulus>& annuli);

// The cheapest `limit` particles of which none is in the neighbourhood of a cheaper one.
std::vector<Pose> diverse(const std::vector<Pose>& particles, const std::vector<double>& cost, double radius,
                          std::size_t limit);

// At most `limit` modes, best first, none nearer than Mahalanobis distance 3 to a better one under its H + Pi
// and none hopelessly worse than the best.
Places distinct(const Places& modes, std::size_t limit);

// The places of pose 1 of `graph` relative to pose 0, which is fixed: particles weighted by `spread`, the
// same graph with the grid's width in its sigmas, then fitted, and `warm` ones besides.
Places find_places(const Graph& graph, const Graph& spread, const std::vector<Anchor>& anchors,
                   const std::vector<Annulus>& annuli, const std::vector<Pose>& warm, const Vector3& pi,
                   std::size_t limit);

}  // namespace dgorl
