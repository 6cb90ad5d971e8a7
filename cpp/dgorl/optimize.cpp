#include "dgorl/optimize.hpp"

#include <cmath>
#include <stdexcept>
#include <utility>

#include "dgorl/covariance.hpp"

namespace dgorl {
namespace {

constexpr double kRounding = 1e-13;      // relative cost increase that is not one
constexpr double kNegligible = 1e-9;     // damping below this is dropped: the last steps are Newton's
constexpr double kSmallestRaise = 1e-8;  // where damping starts again after it was dropped
constexpr double kGaugeDamping = 1e-8;   // enough to make a graph without a gauge regular
constexpr double kLargestDamping = 1e12;
constexpr double kAsPromised = 0.1;  // a gain this near to 1 needs no damping
constexpr int kNewtonTries = 3;      // with more damping, before Gauss-Newton takes over
constexpr double kSafety = 1e-3;
constexpr double kClose = 5.0;  // a Gauss-Newton step below this [m, rad] lets Newton try again

// The paper's damping rule: a smaller error lowers lambda, a larger one raises it, ever faster.
struct Damping {
  double value, growth = 4.0, floor = 0.0;

  // gain: decrease of the cost in shares of what the linearisation promised.
  void accept(double gain) {
    value *= gain > 0.7 ? 0.1 : gain > 0.3 ? 0.5 : 2.0;
    if (value < kNegligible || std::abs(gain - 1.0) < kAsPromised) value = floor;
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
    if (at >= 0) to[k] = from[k].exp(-step_[at], -step_[at + 1], -step_[at + 2]);
  }
  return step_.size() ? step_.cwiseAbs().maxCoeff() : 0.0;
}

void Optimizer::linearize(const std::vector<Pose>& poses, Weighting weighting) {
  weighting_ = weighting;
  graph_.linearize(poses.data(), weighting, normal_);
}

// One step from `poses`, which it replaces where it is short or accepted.
Optimizer::Outcome Optimizer::try_step(std::vector<Pose>& poses, double damping, const Options& options) {
  if (cholesky_.factorize(normal_.hessian, damping) >= 0) return Outcome::kSingular;
  step_ = normal_.gradient;
  cholesky_.solve(step_);
  promised_ = normal_.gradient.dot(step_);
  const double before = length_;
  length_ = apply(poses, trial_);
  if (length_ < options.step_tolerance) return Outcome::kShort;

  const double limit = normal_.cost + kRounding * (std::abs(normal_.cost) + scale_);
  // Newton's steps shrink as C length^2; where the next one would be far below the tolerance it is not
  // needed.
  const double next = length_ * (length_ / before) * (length_ / before);
  if (weighting_ == Weighting::kNewton && damping == 0.0 && next < kSafety * options.step_tolerance) {
    trial_normal_.cost = graph_.cost(trial_.data());
    if (trial_normal_.cost <= limit) return Outcome::kShort;
  } else {
    graph_.linearize(trial_.data(), weighting_, trial_normal_);
  }
  if (!(trial_normal_.cost <= limit)) return Outcome::kRejected;
  std::swap(poses, trial_);
  std::swap(normal_, trial_normal_);
  return Outcome::kAccepted;
}

// Newton's Hessian while it is positive definite and its steps lower the cost, Gauss-Newton's otherwise.
Result Optimizer::run(std::vector<Pose>& poses, const Options& options) {
  Result result;
  Damping damping{options.initial_damping};
  Damping before_newton = damping;
  trial_ = poses;
  linearize(poses, Weighting::kNewton);
  scale_ = std::abs(normal_.cost);
  length_ = 0.0;
  bool solved = false;         // at least once
  bool full_rejected = false;  // the least damped step from here
  int newton_failed = 0;
  result.reason = Reason::kFailed;
  if (!std::isfinite(normal_.cost)) return result;
  while (result.iterations < options.max_iterations && damping.value <= kLargestDamping) {
    ++result.iterations;
    const double before = normal_.cost;
    const Outcome outcome = try_step(poses, damping.value, options);
    solved = solved || outcome != Outcome::kSingular;
    if (outcome == Outcome::kShort && (damping.value == damping.floor || full_rejected)) {
      std::swap(poses, trial_);
      result.cost = graph_.cost(poses.data());
      result.reason = full_rejected ? Reason::kStalled : Reason::kConverged;
      return result;
    }
    if (outcome == Outcome::kShort) {  // perhaps only because it is damped
      damping.value = damping.floor;
    } else if (outcome == Outcome::kAccepted) {
      damping.accept((before - normal_.cost) / (0.5 * promised_));
      before_newton = damping;
      full_rejected = false;
      newton_failed = 0;
      if (weighting_ != Weighting::kNewton && length_ < kClose) {
        linearize(poses, Weighting::kNewton);
        length_ = 0.0;
      }
    } else if (weighting_ == Weighting::kNewton && ++newton_failed < kNewtonTries && damping.value > 0.0) {
      damping.raise();
    } else if (weighting_ == Weighting::kNewton) {
      damping = before_newton;  // what Newton's Hessian lacked is no reason to shorten the other's steps
      linearize(poses, Weighting::kTriggs);
      length_ = 0.0;
    } else {
      full_rejected = full_rejected || (outcome == Outcome::kRejected && damping.value == damping.floor);
      // A graph without a gauge is singular everywhere: keep the least damping that makes it regular.
      if (outcome == Outcome::kSingular && damping.value == 0.0) damping.floor = kGaugeDamping;
      damping.raise();
    }
  }
  result.cost = normal_.cost;
  if (damping.value <= kLargestDamping)
    result.reason = Reason::kMaxIterations;
  else if (solved)
    result.reason = Reason::kStalled;
  return result;
}

Matrix Optimizer::covariance(const std::vector<Pose>& poses, const std::vector<int>& select) {
  graph_.linearize(poses.data(), Weighting::kIrls, normal_);
  return joint_covariance(graph_.layout(), normal_, cholesky_, select);
}

}  // namespace dgorl
