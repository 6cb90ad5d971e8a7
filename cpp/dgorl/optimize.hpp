// Levenberg-Marquardt on the window graph. METHOD section 5.
#pragma once

#include <vector>

#include "dgorl/graph.hpp"

namespace dgorl {

struct Options {
  int max_iterations = 50;
  double step_tolerance = 1e-9;  // largest component of the last step or of the one left out [m, rad]
  double initial_damping = 1e-6;
};

void check(const Options& options);

// converged: the last step was short, or Newton's convergence says that the next one would be.
enum class Reason { kConverged, kStalled, kMaxIterations, kFailed };
const char* name(Reason reason);

struct Result {
  double cost = 0.0;
  int iterations = 0;  // linear systems solved
  Reason reason = Reason::kMaxIterations;
};

class Optimizer {
 public:
  explicit Optimizer(const Graph& graph);

  // Improves `poses` in place. Each run is independent of the ones before it.
  Result run(std::vector<Pose>& poses, const Options& options);

  // Joint covariance of the selected poses where the last run ended.
  Matrix covariance(const std::vector<Pose>& poses, const std::vector<int>& select);

 private:
  enum class Outcome { kSingular, kShort, kAccepted, kRejected };

  void linearize(const std::vector<Pose>& poses, Weighting weighting);
  Outcome try_step(std::vector<Pose>& poses, double damping, const Options& options);
  double apply(const std::vector<Pose>& from, std::vector<Pose>& to) const;

  const Graph& graph_;
  NormalEquations normal_, trial_normal_;
  BlockCholesky cholesky_;
  Vector step_;
  std::vector<Pose> trial_;
  Weighting weighting_ = Weighting::kNewton;
  double scale_ = 0.0;     // of the cost at the start
  double length_ = 0.0;    // of the last step
  double promised_ = 0.0;  // twice the decrease of the cost that it promised, undamped
};

}  // namespace dgorl
