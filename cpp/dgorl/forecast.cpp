#include "dgorl/forecast.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <complex>
#include <vector>

namespace dgorl {
namespace {

using Complex = std::complex<double>;
using Matrix = Eigen::MatrixXd;
using Vector = Eigen::VectorXd;
using Index = Eigen::Index;

constexpr double kLeast = 1e-12;  // [m^2, rad^2] nothing foreseen is exact

// Gaussian velocities over consecutive steps, and headings: in the middle of each step, then at the end.
struct Steps {
  Vector length;              // [s]
  Matrix twist;               // (n, 3), means
  Matrix vx, vy;              // (n, n), covariances
  Vector heading;             // (n + 1), means
  Matrix heading_covariance;  // (n + 1, n + 1)
};

Steps foreseen(const Habit& habit, const Vector3& twist, double duration) {
  const Index n = std::max<Index>(1, static_cast<Index>(std::ceil(duration / habit.length - 1e-9)));
  Steps out{Vector::Constant(n, habit.length), Matrix(n, 3), {}, {}, {}, {}};
  out.length[n - 1] = duration - static_cast<double>(n - 1) * habit.length;
  Matrix time = Matrix::Zero(n + 1, n);  // from turn rates to headings
  for (Index j = 0; j <= n; ++j) {
    time.row(j).head(j) = out.length.head(j).transpose();
    if (j < n) time(j, j) = 0.5 * out.length[j];
  }
  Matrix from_shocks[3];
  for (int c = 0; c < 3; ++c) {
    Matrix& shocks = from_shocks[c] = Matrix::Identity(n, n);
    double deviation = twist[c] - habit.mean[c];
    for (Index j = 0; j < n; ++j) {
      deviation *= habit.keep[c];
      out.twist(j, c) = habit.mean[c] + deviation;
      if (j > 0) shocks.row(j).head(j) = habit.keep[c] * shocks.row(j - 1).head(j);
    }
  }
  const auto velocity = [&](int c) {
    const Matrix same = Matrix::Constant(n, n, habit.drift[c]);
    return Matrix(habit.shock[c] * (from_shocks[c] * from_shocks[c].transpose()) + same);
  };
  out.vx = velocity(0);
  out.vy = velocity(1);
  out.heading = time * out.twist.col(2);
  const Matrix shocks = time * from_shocks[2];
  const Vector elapsed = time.rowwise().sum();
  out.heading_covariance =
      habit.shock[2] * (shocks * shocks.transpose()) + habit.drift[2] * (elapsed * elapsed.transpose());
  for (Index j = 0; j <= n; ++j)
    for (Index k = 0; k <= n; ++k)
      out.heading_covariance(j, k) += habit.heading * std::min(elapsed[j], elapsed[k]);
  return out;
}

// E exp(i theta), theta Gaussian.
Complex unit(double mean, double variance) { return std::polar(std::exp(-0.5 * variance), mean); }

// Mean and covariance of where the steps lead, sum_j way_j exp(i heading_j), exact however far headings
// spread.
Travelled moments(const Steps& steps) {
  const Index n = steps.length.size();
  const Matrix& spread = steps.heading_covariance;
  std::vector<Complex> way(static_cast<std::size_t>(n));
  Complex mean = 0.0, with_heading = 0.0, squared = 0.0;
  double modulus = 0.0;
  for (Index j = 0; j < n; ++j) {
    const double half = 0.5 * steps.twist(j, 2) * steps.length[j];
    const double chord = std::abs(half) < 1e-4 ? 1.0 - half * half / 6.0 : std::sin(half) / half;
    way[j] = steps.length[j] * chord * Complex(steps.twist(j, 0), steps.twist(j, 1));
    const Complex led = way[j] * unit(steps.heading[j], spread(j, j));
    mean += led;
    with_heading += Complex(0.0, spread(j, n)) * led;
    for (Index k = 0; k <= j; ++k) {
      const double times = j == k ? 1.0 : 2.0, area = steps.length[j] * steps.length[k];
      const double both = spread(j, j) + spread(k, k), shared = 2.0 * spread(j, k);
      const double vx = steps.vx(j, k), vy = steps.vy(j, k);
      const Complex apart = way[j] * std::conj(way[k]) + area * (vx + vy);
      const Complex along = way[j] * way[k] + area * (vx - vy);
      modulus += times * (apart * unit(steps.heading[j] - steps.heading[k], both - shared)).real();
      squared += times * along * unit(steps.heading[j] + steps.heading[k], both + shared);
    }
  }
  const double xx = 0.5 * (modulus + squared.real()) - mean.real() * mean.real();
  const double yy = 0.5 * (modulus - squared.real()) - mean.imag() * mean.imag();
  const double xy = 0.5 * squared.imag() - mean.real() * mean.imag();
  const double xt = with_heading.real(), yt = with_heading.imag();
  Matrix3 covariance, turn = Matrix3::Identity();
  covariance << xx, xy, xt, xy, yy, yt, xt, yt, spread(n, n);
  const Pose delta(mean.real(), mean.imag(), wrap(steps.heading[n]));
  turn.topLeftCorner<2, 2>() = delta.rotation();
  return {delta, turn.transpose() * covariance * turn};
}

}  // namespace

Travelled forecast(const Habit& habit, const Vector3& twist, double duration, const MotionModel& model) {
  const double seen = std::min(duration, kForeseen);
  Travelled out = moments(foreseen(habit, twist, seen));
  out.covariance +=
      Vector3(habit.position * seen + kLeast, habit.position * seen + kLeast, kLeast).asDiagonal();
  if (duration > seen) out.append(Pose(), limit_noise(duration - seen, model));
  return out;
}

}  // namespace dgorl
