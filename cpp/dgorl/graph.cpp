#include "dgorl/graph.hpp"

#include <algorithm>
#include <set>

namespace dgorl {

Edge::Edge(const Layout& layout, int pose_i, int pose_j)
    : i(pose_i),
      j(pose_j),
      start_i(layout.start(pose_i)),
      start_j(layout.start(pose_j)),
      ii(layout.place(pose_i, pose_i, nullptr)),
      jj(layout.place(pose_j, pose_j, nullptr)),
      first_block(std::min(layout.block(pose_i), layout.block(pose_j))) {
  int row = pose_i;
  ij = layout.place(pose_i, pose_j, &row);
  j_is_row = row == pose_j;
}

namespace {

template <class Factor>
double group_cost(const Group<Factor>& group, const Pose* poses) {
  double sum = 0.0;
  for (std::size_t k = 0; k < group.factors.size(); ++k) {
    const Edge& edge = group.edges[k];
    const auto e = group.factors[k](poses[edge.i], poses[edge.j], nullptr, nullptr);
    const double s = e.squaredNorm();
    sum += group.kernel.applies(e[0]) ? group.kernel(s).value : s;
  }
  return 0.5 * sum;
}

double group_cost(const Prior& prior, const Pose* poses) { return prior.cost(poses); }

template <class Factor>
void linearize_group(const Group<Factor>& group, const Pose* poses, Weighting weighting, int blocks,
                     NormalEquations& normal) {
  Jacobians<Factor::kDim> jac;
  Curvature second;
  Curvature* curvature = weighting == Weighting::kNewton ? &second : nullptr;
  double sum = 0.0;
  for (std::size_t k = 0; k < group.factors.size(); ++k) {
    const Edge& edge = group.edges[k];
    if (edge.first_block >= blocks && blocks != kNoBlock) continue;
    const auto e = group.factors[k](poses[edge.i], poses[edge.j], &jac, curvature);
    const double s = e.squaredNorm();
    Kernel::Rho rho{s, 1.0, 1.0};
    if (group.kernel.applies(e[0])) rho = group.kernel(s);
    sum += rho.value;
    add_factor<Factor::kDim>(edge, jac, curvature, e, rho.weight, Kernel::hessian_weight(rho, weighting),
                             normal);
  }
  normal.cost += 0.5 * sum;
}

void linearize_group(const Prior& prior, const Pose* poses, Weighting weighting, int blocks,
                     NormalEquations& normal) {
  if (prior.first_block() < blocks || blocks == kNoBlock)
    prior.linearize(poses, weighting == Weighting::kNewton, normal);
}

template <class Factor>
Residuals group_residuals(const Group<Factor>& group, const Pose* poses) {
  Residuals out{Factor::kName, Matrix(group.factors.size(), Factor::kDim)};
  for (std::size_t k = 0; k < group.factors.size(); ++k)
    out.values.row(k) =
        group.factors[k](poses[group.edges[k].i], poses[group.edges[k].j], nullptr, nullptr).transpose();
  return out;
}

Residuals group_residuals(const Prior& prior, const Pose* poses) {
  return {Prior::kName, prior.residual(poses)};
}

template <class Factor>
void collect(const Group<Factor>& group, int block, std::vector<int>& out) {
  for (const Edge& edge : group.edges)
    if (edge.first_block < block) out.insert(out.end(), {edge.i, edge.j});
}

void collect(const Prior& prior, int block, std::vector<int>& out) {
  if (prior.first_block() < block) out.insert(out.end(), prior.variables().begin(), prior.variables().end());
}

}  // namespace

double Graph::cost(const Pose* poses) const {
  double sum = 0.0;
  for (const AnyGroup& any : groups_)
    sum += std::visit([&](const auto& group) { return group_cost(group, poses); }, any);
  return sum;
}

std::vector<Residuals> Graph::residuals(const Pose* poses) const {
  std::vector<Residuals> out;
  for (const AnyGroup& any : groups_)
    out.push_back(std::visit([&](const auto& group) { return group_residuals(group, poses); }, any));
  return out;
}

void Graph::linearize(const Pose* poses, Weighting weighting, NormalEquations& normal, int blocks) const {
  normal.set_zero();
  for (const AnyGroup& any : groups_)
    std::visit([&](const auto& group) { linearize_group(group, poses, weighting, blocks, normal); }, any);
}

std::vector<int> Graph::touched(int block) const {
  std::vector<int> all, kept;
  for (const AnyGroup& any : groups_) std::visit([&](const auto& group) { collect(group, block, all); }, any);
  for (int pose : std::set<int>(all.begin(), all.end()))
    if (!layout_.fixed(pose) && layout_.block(pose) >= block) kept.push_back(pose);
  return kept;
}

}  // namespace dgorl
