// g2o in C++ with the edges it lacks, ranges and RSSI, as fast as its wheel's headers and static libraries
// allow: blocks of fixed size, analytic Jacobians, no Python in the loop. Called through ctypes; METHOD
// section 2.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <ctime>
#include <memory>
#include <utility>
#include <vector>

#include "g2o/core/base_binary_edge.h"
#include "g2o/core/block_solver.h"
#include "g2o/core/optimization_algorithm_levenberg.h"
#include "g2o/core/sparse_optimizer.h"
#include "g2o/solvers/eigen/linear_solver_eigen.h"
#include "g2o/types/slam2d/edge_se2.h"
#include "g2o/types/slam2d/vertex_se2.h"

namespace {

using Blocks = g2o::BlockSolver<g2o::BlockSolverTraits<3, 3>>;
constexpr double kMinimumDistance = 0.1;  // of the path-loss model [m]
constexpr double kNearest = 1e-3;         // of a range's gradient [m]
constexpr double kInitialDamping = 1e-6;  // the native core's; g2o's own guess takes twice the iterations

class Scalar : public g2o::BaseBinaryEdge<1, double, g2o::VertexSE2, g2o::VertexSE2> {
 protected:
  // From vertex 1 to vertex 0, in the world's axes, along which g2o takes its steps.
  Eigen::Vector2d off() const {
    return vertexXnRaw<0>()->estimate().translation() - vertexXnRaw<1>()->estimate().translation();
  }
  void slope(const Eigen::Vector2d& s) {
    jacobianOplusXi_ << s.x(), s.y(), 0.0;
    jacobianOplusXj_ << -s.x(), -s.y(), 0.0;
  }
};

class RangeEdge final : public Scalar {
 public:
  void computeError() override { error_[0] = off().norm() - measurement_; }
  void linearizeOplus() override { slope(off() / std::max(off().norm(), kNearest)); }
};

class RssiEdge final : public Scalar {
 public:
  RssiEdge(double at_1m, double exponent) : at_1m_(at_1m), loss_(10.0 * exponent / std::log(10.0)) {}
  void computeError() override {
    error_[0] = measurement_ - (at_1m_ - loss_ * std::log(std::max(off().norm(), kMinimumDistance)));
  }
  void linearizeOplus() override {
    const double squared = off().squaredNorm();
    slope(off() * (squared > kMinimumDistance * kMinimumDistance ? loss_ / squared : 0.0));
  }

 private:
  double at_1m_, loss_;
};

double cpu_seconds() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

g2o::SE2 se2(const double* pose) { return g2o::SE2(pose[0], pose[1], pose[2]); }

}  // namespace

extern "C" {

struct Graph {
  std::int64_t poses;
  const std::int64_t* ids;    // (poses), of the vertices: their order before the system is permuted
  const double* initial;      // (poses, 3)
  const std::uint8_t* fixed;  // (poses)
  std::int64_t relatives;     // relative poses, odometry among them
  const std::int64_t* from;   // (relatives)
  const std::int64_t* to;     // (relatives)
  const double* delta;        // (relatives, 3)
  const double* information;  // (relatives, 3, 3)
  std::int64_t readings;      // RSSI or ranges
  const std::int64_t* i;      // (readings)
  const std::int64_t* j;      // (readings)
  const double* value;        // (readings), dBm or m
  const double* sigma;        // (readings), dB or m
  std::int32_t is_rssi;
  double at_1m, exponent;  // of the path-loss model
};

// Builds the graph, takes `iterations` of Levenberg-Marquardt, and the marginals of the selected poses.
// poses (poses, 3), covariance (3m, 3m) in the world's axes and seconds (3) of CPU time are written.
// Returns the iterations taken; -1 if the optimisation fails, -2 if the marginals do.
std::int64_t dgorl_g2o(const Graph* graph, std::int64_t iterations, std::int64_t selected,
                       const std::int64_t* select, double* poses, double* covariance, double* seconds) {
  const double began = cpu_seconds();
  g2o::SparseOptimizer optimizer;
  auto linear = std::make_unique<g2o::LinearSolverEigen<Blocks::PoseMatrixType>>();
  linear->setBlockOrdering(true);
  auto algorithm =
      std::make_unique<g2o::OptimizationAlgorithmLevenberg>(std::make_unique<Blocks>(std::move(linear)));
  algorithm->setUserLambdaInit(kInitialDamping);
  optimizer.setAlgorithm(std::move(algorithm));
  std::vector<std::shared_ptr<g2o::VertexSE2>> vertices(graph->poses);
  for (std::int64_t k = 0; k < graph->poses; ++k) {
    vertices[k] = std::make_shared<g2o::VertexSE2>();
    vertices[k]->setId(static_cast<int>(graph->ids[k]));
    vertices[k]->setEstimate(se2(graph->initial + 3 * k));
    vertices[k]->setFixed(graph->fixed[k] != 0);
    optimizer.addVertex(vertices[k]);
  }
  for (std::int64_t k = 0; k < graph->relatives; ++k) {
    auto edge = std::make_shared<g2o::EdgeSE2>();
    edge->setVertex(0, vertices[graph->from[k]]);
    edge->setVertex(1, vertices[graph->to[k]]);
    edge->setMeasurement(se2(graph->delta + 3 * k));
    edge->setInformation(Eigen::Map<const Eigen::Matrix3d>(graph->information + 9 * k));
    optimizer.addEdge(edge);
  }
  for (std::int64_t k = 0; k < graph->readings; ++k) {
    std::shared_ptr<Scalar> edge;
    if (graph->is_rssi)
      edge = std::make_shared<RssiEdge>(graph->at_1m, graph->exponent);
    else
      edge = std::make_shared<RangeEdge>();
    edge->setVertex(0, vertices[graph->i[k]]);
    edge->setVertex(1, vertices[graph->j[k]]);
    edge->setMeasurement(graph->value[k]);
    edge->setInformation(Eigen::Matrix<double, 1, 1>(1.0 / (graph->sigma[k] * graph->sigma[k])));
    optimizer.addEdge(edge);
  }
  optimizer.initializeOptimization();
  const double built = cpu_seconds();
  const int taken = optimizer.optimize(static_cast<int>(iterations));
  const double optimised = cpu_seconds();
  std::vector<std::pair<int, int>> pattern;
  for (std::int64_t a = 0; a < selected; ++a)
    for (std::int64_t b = 0; b < selected; ++b) {
      const int row = vertices[select[a]]->hessianIndex(), column = vertices[select[b]]->hessianIndex();
      if (row <= column) pattern.emplace_back(row, column);
    }
  g2o::SparseBlockMatrix<g2o::MatrixX> inverse;
  const bool known = taken > 0 && optimizer.computeMarginals(inverse, pattern);
  const double ended = cpu_seconds();
  if (taken <= 0) return -1;
  if (!known) return -2;
  for (std::int64_t k = 0; k < graph->poses; ++k)
    Eigen::Map<Eigen::Vector3d>(poses + 3 * k) = vertices[k]->estimate().toVector();
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  Eigen::Map<RowMajor> joint(covariance, 3 * selected, 3 * selected);
  for (std::int64_t a = 0; a < selected; ++a)
    for (std::int64_t b = 0; b < selected; ++b) {
      const int row = vertices[select[a]]->hessianIndex(), column = vertices[select[b]]->hessianIndex();
      if (row > column) continue;
      joint.block<3, 3>(3 * a, 3 * b) = *inverse.block(row, column);
      joint.block<3, 3>(3 * b, 3 * a) = inverse.block(row, column)->transpose();
    }
  seconds[0] = built - began;
  seconds[1] = optimised - built;
  seconds[2] = ended - optimised;
  return taken;
}

}  // extern "C"
