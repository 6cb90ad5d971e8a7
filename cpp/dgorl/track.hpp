// Tracks: a robot's trajectory in one epoch, as keyframes joined by preintegrated odometry. METHOD section 1.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "dgorl/habit.hpp"

namespace dgorl {

// Where a stamp falls on a track: keyframe index, and pose in that keyframe's frame.
struct Location {
  std::int64_t keyframe;
  Pose offset;
};

struct KeyframeInterval {
  Vector3 delta;
  Matrix3 information;
};

// Steps rising in time, cut at the keyframes; keyframe k stands at k / 2 s. Before its first odometry a robot
// stands still: the first keyframe is the last grid time at or before begin.
class Track {
 public:
  Track(double begin, std::int64_t epoch);

  const double begin;
  const std::int64_t epoch;
  std::int64_t number = -1;  // what the caller's arrays call this track

  bool empty() const { return pieces_.empty(); }
  std::int64_t first() const { return first_; }
  std::int64_t last() const { return first_ + static_cast<std::int64_t>(intervals_.size()); }
  double end() const;
  // Twist of the odometry up to a stamp, zero before the first.
  Vector3 twist_at(double stamp) const;

  // Until when odometry that began before stamp tells of this track, at most stamp; -infinity if none does.
  double known(double stamp) const;
  // The first time from stamp on at which odometry tells more, infinity if never: a gap says so only at its
  // end.
  double next(double stamp) const;
  // The newest keyframe known from odometry that began before stamp.
  std::int64_t newest(double stamp) const;
  const KeyframeInterval& interval(std::int64_t keyframe) const { return intervals_[keyframe - first_]; }

  // Takes a step that follows on; completes the keyframe intervals it ends.
  void append(const Step& step);
  // Stamps between begin and end.
  Location locate(double stamp) const;
  // The part of the motion to stamp that odometry has not told of yet: foreseen.
  Travelled ahead(double stamp, const MotionModel& model) const;
  // Motion since the newest keyframe to stamp, foreseen where odometry has not come yet.
  Travelled carried(double stamp, const MotionModel& model) const;
  // Drops what lies before a keyframe; the track keeps its name.
  void forget(std::int64_t before);
  // An empty track of the same name whose first keyframe is that one.
  std::shared_ptr<Track> restarted() const;

 private:
  struct Piece {
    Step step;
    std::int64_t keyframe;
    Pose offset;  // pose at its start in the keyframe's frame
  };

  std::int64_t first_;
  std::vector<Piece> pieces_;
  std::vector<KeyframeInterval> intervals_;
  Travelled open_;  // since the last keyframe
  DriveRecord record_;
};

// All tracks of one robot, from its odometry in canonical order.
class Trail {
 public:
  explicit Trail(const MotionModel& model) : model_(model) {}

  const std::vector<std::shared_ptr<Track>>& tracks() const { return tracks_; }
  const MotionModel& model() const { return model_; }

  // Appends rows that follow on: overlap is cut off, up to kHeld is bridged; a new epoch, a longer gap or a
  // jump, which is left out, begins a new track.
  void extend(const std::vector<OdometryRow>& rows);
  // Forgets all steps, to be built anew; what was dropped for good stays named.
  void restart();
  void forget(std::int64_t before);

 private:
  MotionModel model_;
  std::vector<std::shared_ptr<Track>> tracks_;
  std::shared_ptr<Track> root_;
  bool jumped_ = false;  // the last row was a jump
};

}  // namespace dgorl
