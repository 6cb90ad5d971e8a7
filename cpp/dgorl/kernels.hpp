// Robust kernels rho(s) of the squared Mahalanobis norm s; the cost of a factor is rho(s) / 2. METHOD
// section 2.
#pragma once

#include <algorithm>
#include <cmath>

namespace dgorl {

// The one-sided kernels are robust where e < 0 and quadratic elsewhere: NLOS makes ranges long and RSSI weak.
enum class KernelType { kNone = 0, kHuber = 1, kCauchy = 2, kHuberNegative = 3, kCauchyNegative = 4 };

// What goes into the Hessian. kIrls: Gauss-Newton with robust weights rho', which is what covariances and
// frozen priors mean. kTriggs: with the kernel's curvature too, bounded below so that it stays positive
// semi-definite. kNewton: everything, indefinite far from an optimum but quadratically convergent near one.
enum class Weighting { kIrls, kTriggs, kNewton };

struct Kernel {
  KernelType type = KernelType::kNone;
  double width = 1.0;

  // Value, first derivative and curvature rho' + 2 rho'' s at s.
  struct Rho {
    double value, weight, curvature;
  };

  bool one_sided() const { return type == KernelType::kHuberNegative || type == KernelType::kCauchyNegative; }
  bool applies(double e) const { return type != KernelType::kNone && (e < 0.0 || !one_sided()); }

  Rho operator()(double s) const {
    const double c2 = width * width;
    if (type == KernelType::kHuber || type == KernelType::kHuberNegative) {
      if (s <= c2) return {s, 1.0, 1.0};
      const double root = std::sqrt(s);
      return {2.0 * width * root - c2, width / root, 0.0};
    }
    const double q = 1.0 + s / c2;
    return {c2 * std::log1p(s / c2), 1.0 / q, (1.0 - s / c2) / (q * q)};
  }

  // The factor on the Hessian along the residual.
  static double hessian_weight(const Rho& rho, Weighting weighting) {
    if (weighting == Weighting::kIrls) return rho.weight;
    return weighting == Weighting::kNewton ? rho.curvature : std::max(rho.curvature, 0.1 * rho.weight);
  }
};

}  // namespace dgorl
