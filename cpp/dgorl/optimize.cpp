#include "dgorl/optimize.hpp"

#include <cmath>
#include <stdexcept>
#include <utility>

#include "dgorl/covariance.hpp"

namespace dgorl {
namespace {

constexpr double kRounding = 1e-13;      // relative cost increase that is not one
constexpr double kNegligible = 1e-8;     // damping below this is dropped: the last steps are Newton's
constexpr double kSmallestRaise = 1e-6;  // where damping starts again after it was dropped
constexpr double kLargestDamping = 1e12;
constexpr double kClose = 0.1;  // a Gauss-Newton step below this [m, rad] lets Newton try again

// The paper's damping rule: a smaller error lowers lambda, a larger one raises it, ever faster.
struct Damping {
  double value, growth = 4.0, floor = 0.0;

  void lower() {
    value = value * 0.1 < kNegligible ? floor : value * 0.1;
    growth = 4.0;
  }
  void raise() {
    value = std::max(value * growth, kSmallestRaise);
    growth *= 2.0;
  }
};

}  // namespace

void check(const Options& options) {
  if (options.max_iterations < 0) throw std::invalid_argument("max_iterations: must not be negative");
  if (!(options.step_tolerance > 0.0) || !std::isfinite(options.step_tolerance))
    throw std::invalid_argument("step_tolerance: must be positive");
  if (!(options.initial_damping >= 0.0) || !std::isfinite(options.initial_damping))
    throw std::invalid_argument("initial_damping: must not be negative");
}

const char* name(Reason reason) {
  switch (reason) {
    case Reason::kConverged:
      return "converged";
    case Reason::kStalled:
      return "stalled";
    case Reason::kMaxIterations:
      return "max_iterations";
    case Reason::kFailed:
      break;
  }
  return "failed";
}

Optimizer::Optimizer(const Graph& graph)
    : graph_(graph),
      normal_(graph.layout()),
      trial_normal_(graph.layout()),
      cholesky_(graph.layout()),
      step_(graph.layout().variables()) {}

// to = from . (-step); returns the largest component of the step.
double Optimizer::apply(const std::vector<Pose>& from, std::vector<Pose>& to) const {
  const Layout& layout = graph_.layout();
  for (int k = 0; k < layout.poses(); ++k) {
    const int at = layout.start(k);
    if (at >= 0) to[k] = from[k].retract(-step_[at], -step_[at + 1], -step_[at + 2]);
  }
  return step_.size() ? step_.cwiseAbs().maxCoeff() : 0.0;
}

// Newton's Hessian while it is positive definite and its steps lower the cost, Gauss-Newton's otherwise.
Result Optimizer::run(std::vector<Pose>& poses, const Options& options) {
  Result result;
  Damping damping{options.initial_damping};
  Weighting weighting = Weighting::kNewton;
  trial_ = poses;
  graph_.linearize(poses.data(), weighting, normal_);
  const double start_cost = result.cost = normal_.cost;
  result.reason = Reason::kFailed;
  if (!std::isfinite(start_cost)) return result;
  bool solved = false;  // at least once
  while (result.iterations < options.max_iterations) {
    if (damping.value > kLargestDamping) {
      if (solved) result.reason = Reason::kStalled;
      return result;
    }
    ++result.iterations;
    const bool regular = cholesky_.factorize(normal_.hessian, damping.value) < 0;
    double length = 0.0;
    if (regular) {
      solved = true;
      step_ = normal_.gradient;
      cholesky_.solve(step_);
      length = apply(poses, trial_);
      if (length < options.step_tolerance) {
        // A damped step may be short because it is damped: only an undamped one, where there is one, ends it.
        if (damping.value > damping.floor) {
          damping.value = damping.floor;
          continue;
        }
        std::swap(poses, trial_);
        result.cost = graph_.cost(poses.data());
        result.reason = Reason::kConverged;
        return result;
      }
      graph_.linearize(trial_.data(), weighting, trial_normal_);
      const double rounding = kRounding * (std::abs(normal_.cost) + std::abs(start_cost));
      if (trial_normal_.cost <= normal_.cost + rounding) {
        std::swap(poses, trial_);
        std::swap(normal_, trial_normal_);
        result.cost = normal_.cost;
        damping.lower();
        if (weighting != Weighting::kNewton && length < kClose) {
          weighting = Weighting::kNewton;
          graph_.linearize(poses.data(), weighting, normal_);
        }
        continue;
      }
    }
    if (weighting == Weighting::kNewton) {
      weighting = Weighting::kTriggs;
      graph_.linearize(poses.data(), weighting, normal_);
      continue;
    }
    // A graph without a gauge is singular everywhere: keep the least damping that makes it regular.
    if (!regular && damping.value == 0.0) damping.floor = kNegligible;
    damping.raise();
  }
  result.reason = Reason::kMaxIterations;
  return result;
}

Matrix Optimizer::covariance(const std::vector<Pose>& poses, const std::vector<int>& select) {
  graph_.linearize(poses.data(), Weighting::kIrls, normal_);
  return joint_covariance(graph_.layout(), normal_, cholesky_, select);
}

}  // namespace dgorl
