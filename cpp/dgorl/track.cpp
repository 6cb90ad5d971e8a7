#include "dgorl/track.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>

#include "dgorl/forecast.hpp"

namespace dgorl {
namespace {

constexpr double kLeastVariance =
    1e-12;  // [m^2, rad^2] keeps the information of odometry without noise finite
constexpr double kInfinity = std::numeric_limits<double>::infinity();

double share_at(const Step& step, double stamp) {
  return std::clamp((stamp - step.start) / (step.end - step.start), 0.0, 1.0);
}

}  // namespace

Track::Track(double begin_, std::int64_t epoch_)
    : begin(begin_), epoch(epoch_), first_(keyframe_before(begin_)) {}

double Track::end() const { return pieces_.empty() ? begin : pieces_.back().step.end; }

Vector3 Track::twist_at(double stamp) const {
  const auto next = std::lower_bound(pieces_.begin(), pieces_.end(), stamp,
                                     [](const Piece& p, double t) { return p.step.start < t; });
  if (next == pieces_.begin()) return Vector3::Zero();
  const Step& step = std::prev(next)->step;
  return log(step.delta) / (step.end - step.start);
}

double Track::known(double stamp) const {
  const auto next = std::lower_bound(pieces_.begin(), pieces_.end(), stamp,
                                     [](const Piece& p, double t) { return p.step.origin < t; });
  return next == pieces_.begin() ? -kInfinity : std::min(std::prev(next)->step.end, stamp);
}

double Track::next(double stamp) const {
  const auto piece = std::upper_bound(pieces_.begin(), pieces_.end(), stamp,
                                      [](double t, const Piece& p) { return t < p.step.end; });
  return piece == pieces_.end() ? kInfinity : std::max(piece->step.origin, stamp);
}

std::int64_t Track::newest(double stamp) const {
  const double until = known(stamp);
  return std::isfinite(until) ? std::max(keyframe_before(until), first_) : first_;
}

void Track::append(const Step& step) {
  double start = step.start;
  for (std::int64_t k = keyframe_before(start); start < step.end; ++k) {
    const double border = static_cast<double>(k + 1) / kKeyframesPerSecond;
    const double end = std::min(step.end, border);
    const double share = (end - start) / (step.end - step.start);
    const Step piece{start, end, step.origin, part(step.delta, share), step.covariance * share};
    pieces_.push_back({piece, k, open_.delta});
    open_.append(Pose(piece.delta.data()), piece.covariance);
    if (end == border) {
      const Matrix3 information = (open_.covariance + kLeastVariance * Matrix3::Identity()).inverse();
      intervals_.push_back({open_.delta.vec(), 0.5 * (information + information.transpose())});
      open_ = Travelled();
    }
    start = end;
  }
  record_.append(step, step.origin <= step.start + kRounding);
}

Location Track::locate(double stamp) const {
  const std::int64_t keyframe = std::max(keyframe_before(stamp), first_);
  auto next = std::upper_bound(pieces_.begin(), pieces_.end(), stamp,
                               [](double t, const Piece& p) { return t < p.step.start; });
  if (next == pieces_.begin()) return {keyframe, Pose()};
  const Piece& piece = *std::prev(next);
  if (piece.keyframe != keyframe) return {keyframe, Pose()};
  return {keyframe, piece.offset * Pose(part(piece.step.delta, share_at(piece.step, stamp)).data())};
}

Travelled Track::carried(double stamp, const MotionModel& model) const {
  const double until = std::max(known(stamp), begin);
  Travelled sum;
  const std::int64_t keyframe = newest(stamp);
  auto piece = std::lower_bound(pieces_.begin(), pieces_.end(), keyframe,
                                [](const Piece& p, std::int64_t k) { return p.keyframe < k; });
  for (; piece != pieces_.end() && piece->step.start < until; ++piece) {
    const double share = share_at(piece->step, until);
    sum.append(Pose(part(piece->step.delta, share).data()), piece->step.covariance * share);
  }
  const Travelled foreseen = ahead(stamp, model);
  sum.append(foreseen.delta, foreseen.covariance);
  return sum;
}

Travelled Track::ahead(double stamp, const MotionModel& model) const {
  const double until = std::max(known(stamp), begin);
  if (stamp <= until) return {};
  const Vector3 twist = twist_at(until);
  return forecast(record_.habit(twist, until, stamp, model), twist, stamp - until, model);
}

void Track::forget(std::int64_t before) {
  before = std::min(before, last());
  const auto from = [this](std::int64_t keyframe) {
    return std::lower_bound(pieces_.begin(), pieces_.end(), keyframe,
                            [](const Piece& p, std::int64_t k) { return p.keyframe < k; });
  };
  // What is kept begins with measured odometry: a bridge cannot be rebuilt without the row before it.
  while (before > first_ && from(before) != pieces_.end() &&
         from(before)->step.origin > from(before)->step.start)
    --before;
  if (before <= first_) return;
  const auto keep = from(before);
  pieces_.erase(pieces_.begin(), keep == pieces_.end() ? std::prev(keep) : keep);
  intervals_.erase(intervals_.begin(), intervals_.begin() + (before - first_));
  first_ = before;
  record_.forget(static_cast<double>(before) / kKeyframesPerSecond);
}

std::shared_ptr<Track> Track::restarted() const {
  auto track = std::make_shared<Track>(begin, epoch);
  track->first_ = first_;
  track->number = number;
  return track;
}

void Trail::extend(const std::vector<OdometryRow>& rows) {
  for (const OdometryRow& row : rows) {
    Step step = measured(row, model_);
    Track* track = tracks_.empty() ? nullptr : tracks_.back().get();
    const bool begun = track != nullptr && !track->empty();
    const double floor = begun   ? track->end()
                         : track ? static_cast<double>(track->first()) / kKeyframesPerSecond
                                 : -kInfinity;
    if (step.end <= floor + kRounding) continue;
    if (jumps(row, model_)) {
      jumped_ = true;
      continue;
    }
    if (step.start < floor - kRounding) step = after(step, floor);
    const double gap = track ? step.start - floor : 0.0;
    if (!track || row.epoch != track->epoch || gap > kHeld || jumped_) {
      tracks_.push_back(std::make_shared<Track>(step.start, row.epoch));
      track = tracks_.back().get();
    } else if (begun && gap > kRounding) {
      track->append(bridge(track->twist_at(floor), floor, step.start, step.start, model_));
    } else if (begun) {
      step.start = floor;
    }
    track->append(step);
    jumped_ = false;
  }
}

void Trail::restart() {
  tracks_.clear();
  jumped_ = false;
  if (root_) tracks_.push_back(root_->restarted());
}

void Trail::forget(std::int64_t before) {
  const double stamp = static_cast<double>(before) / kKeyframesPerSecond;
  std::vector<std::shared_ptr<Track>> kept;
  for (const auto& track : tracks_)
    if (track->end() > stamp || track == tracks_.back()) kept.push_back(track);
  for (const auto& track : kept) track->forget(before);
  tracks_ = std::move(kept);
  // A track that was not cut may still begin earlier, when older odometry comes late.
  const bool cut = !tracks_.empty() && tracks_.front()->first() > keyframe_before(tracks_.front()->begin);
  root_ = cut ? tracks_.front()->restarted() : nullptr;
}

}  // namespace dgorl
