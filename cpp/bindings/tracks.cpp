// Tracks for Python: one call for all robots, never one per reading.
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "arguments.hpp"
#include "dgorl/relative.hpp"
#include "dgorl/track.hpp"

using namespace nb::literals;

namespace dgorl::bindings {
namespace {

using TrackPtr = std::shared_ptr<Track>;

constexpr int kRowColumns = 13;  // start, end, epoch, twist?, 3 values, 6 stated covariances or NaN

MotionModel motion_model(nb::handle values) {
  const Argument<double> v("motion", values, {13});
  const double* p = v.data();
  for (int k = 0; k < 13; ++k)
    if (!std::isfinite(p[k])) throw std::invalid_argument("motion: must be finite");
  return {p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11], p[12]};
}

std::vector<OdometryRow> odometry_rows(nb::handle rows) {
  const Argument<double> table("rows", rows, {kAny, kRowColumns});
  std::vector<OdometryRow> parsed(static_cast<std::size_t>(table.rows()));
  const double* p = table.data();
  for (OdometryRow& row : parsed) {
    for (int k = 0; k < 7; ++k)
      if (!std::isfinite(p[k])) throw std::invalid_argument("rows: must be finite");
    if (!(p[1] > p[0])) throw std::invalid_argument("rows: must end after they start");
    row = {p[0], p[1], static_cast<std::int64_t>(p[2]), p[3] != 0.0, {p[4], p[5], p[6]}, {}};
    std::copy(p + 7, p + kRowColumns, row.stated);
    p += kRowColumns;
  }
  return parsed;
}

// How many rows of odometry are jumps, and no motion.
std::int64_t count_jumps(nb::handle rows, nb::handle motion) {
  const MotionModel model = motion_model(motion);
  const std::vector<OdometryRow> parsed = odometry_rows(rows);
  return std::count_if(parsed.begin(), parsed.end(),
                       [&](const OdometryRow& row) { return jumps(row, model); });
}

// Number, keyframe and offset of each stamp on the tracks of its robot; number -1 where no track covers it.
nb::object locate(const std::vector<Trail*>& trails, nb::handle robots, nb::handle stamps) {
  const IndexArgument robot("robots", robots);
  const Argument<double> stamp("stamps", stamps, {robot.rows()});
  const auto n = static_cast<std::size_t>(robot.rows());
  std::vector<std::int64_t> number(n, -1), keyframe(n, 0);
  std::vector<double> offset(3 * n, 0.0);
  for (std::size_t k = 0; k < n; ++k) {
    const std::int64_t r = robot.data()[k];
    if (r < 0 || r >= static_cast<std::int64_t>(trails.size()))
      throw std::invalid_argument("robots: index out of range");
    if (!std::isfinite(stamp.data()[k])) throw std::invalid_argument("stamps: must be finite");
    if (trails[r] == nullptr) continue;
    for (const TrackPtr& track : trails[r]->tracks()) {
      const double t = stamp.data()[k];
      if (track->empty() || t < track->begin || t > track->end()) continue;
      const Location location = track->locate(t);
      number[k] = track->number;
      keyframe[k] = location.keyframe;
      offset[3 * k] = location.offset.x;
      offset[3 * k + 1] = location.offset.y;
      offset[3 * k + 2] = location.offset.theta;
    }
  }
  return nb::make_tuple(to_numpy(std::move(number)), to_numpy(std::move(keyframe)),
                        to_numpy(std::move(offset), {n, 3}));
}

// Motion and information of the keyframe intervals first[k] ... last[k] of every track, one track after
// another.
nb::object odometry(const std::vector<TrackPtr>& tracks, const std::vector<std::int64_t>& first,
                    const std::vector<std::int64_t>& last) {
  if (first.size() != tracks.size() || last.size() != tracks.size())
    throw std::invalid_argument("first, last: must have one entry per track");
  std::vector<double> delta, information;
  for (std::size_t k = 0; k < tracks.size(); ++k) {
    if (first[k] < tracks[k]->first() || first[k] > last[k] || last[k] > tracks[k]->last())
      throw std::invalid_argument("first, last: must be keyframes of the track");
    for (std::int64_t at = first[k]; at < last[k]; ++at) {
      const KeyframeInterval& interval = tracks[k]->interval(at);
      delta.insert(delta.end(), interval.delta.data(), interval.delta.data() + 3);
      information.insert(information.end(), interval.information.data(), interval.information.data() + 9);
    }
  }
  const std::size_t rows = delta.size() / 3;
  return nb::make_tuple(to_numpy(std::move(delta), {rows, 3}),
                        to_numpy(std::move(information), {rows, 3, 3}));
}

std::vector<Pose> to_poses(const RowArgument<3>& rows) {
  std::vector<Pose> poses;
  for (nb::ssize_t k = 0; k < rows.rows(); ++k) poses.emplace_back(rows.data() + 3 * k);
  return poses;
}

Eigen::MatrixXd joint_covariance(nb::handle covariance, nb::ssize_t n) {
  const Argument<double> joint("covariance", covariance, {3 * n, 3 * n});
  return Square(joint.data(), 3 * n, 3 * n);
}

nb::object from_poses(const std::vector<Pose>& poses) {
  std::vector<double> out;
  for (const Pose& p : poses) out.insert(out.end(), {p.x, p.y, p.theta});
  return to_numpy(std::move(out), {poses.size(), 3});
}

// Poses and joint covariance at the newest keyframes carried on to stamp.
nb::object carry_on(const std::vector<TrackPtr>& tracks, double stamp, nb::handle motion, nb::handle poses,
                    nb::handle covariance) {
  const MotionModel model = motion_model(motion);
  const auto n = static_cast<nb::ssize_t>(tracks.size());
  std::vector<Pose> carried = to_poses(RowArgument<3>("poses", poses, n));
  std::vector<Travelled> motions;
  for (std::size_t k = 0; k < tracks.size(); ++k) {
    motions.push_back(tracks[k]->carried(stamp, model));
    carried[k] = carried[k] * motions[k].delta;
  }
  return nb::make_tuple(from_poses(carried), to_numpy(carry(joint_covariance(covariance, n), motions)));
}

nb::object relative(nb::handle poses, nb::handle covariance, std::int64_t ego) {
  const RowArgument<3> rows("poses", poses);
  if (ego < 0 || ego >= rows.rows()) throw std::invalid_argument("ego: index out of range");
  const std::vector<Relative> seen =
      relative_to(to_poses(rows), joint_covariance(covariance, rows.rows()), static_cast<std::size_t>(ego));
  std::vector<Pose> found;
  std::vector<double> covariances;
  for (const Relative& r : seen) {
    found.push_back(r.pose);
    covariances.insert(covariances.end(), r.covariance.data(), r.covariance.data() + 9);
  }
  return nb::make_tuple(from_poses(found), to_numpy(std::move(covariances), {found.size(), 3, 3}));
}

}  // namespace

void bind_tracks(nb::module_& m) {
  nb::class_<Track>(m, "Track")
      .def_ro("begin", &Track::begin)
      .def_ro("epoch", &Track::epoch)
      .def_rw("number", &Track::number)
      .def_prop_ro("first", &Track::first)
      .def_prop_ro("last", &Track::last)
      .def_prop_ro("end", &Track::end)
      .def("known", &Track::known, "stamp"_a)
      .def("next", &Track::next, "stamp"_a)
      .def("newest", &Track::newest, "stamp"_a)
      .def(
          "foreseen",
          [](const Track& track, double stamp, nb::handle motion) {
            const Matrix3 covariance = track.ahead(stamp, motion_model(motion)).covariance;
            return to_numpy(std::vector<double>(covariance.data(), covariance.data() + 9), {3, 3});
          },
          "stamp"_a, "motion"_a)
      .def(
          "locate",
          [](const Track& track, double stamp) {
            const Location at = track.locate(stamp);
            return nb::make_tuple(at.keyframe, to_numpy(Eigen::VectorXd(at.offset.vec())));
          },
          "stamp"_a);
  nb::class_<Trail>(m, "Trail")
      .def(
          "__init__", [](Trail* self, nb::handle motion) { new (self) Trail(motion_model(motion)); },
          "motion"_a)
      .def_prop_ro("tracks", &Trail::tracks)
      .def(
          "extend", [](Trail& trail, nb::handle rows) { trail.extend(odometry_rows(rows)); }, "rows"_a)
      .def("restart", &Trail::restart)
      .def("forget", &Trail::forget, "before"_a);
  m.def("count_jumps", &count_jumps, "rows"_a, "motion"_a);
  m.def("locate", &locate, "trails"_a, "robots"_a, "stamps"_a);
  m.def("odometry", &odometry, "tracks"_a, "first"_a, "last"_a);
  m.def("carry", &carry_on, "tracks"_a, "stamp"_a, "motion"_a, "poses"_a, "covariance"_a);
  m.def("relative", &relative, "poses"_a, "covariance"_a, "ego"_a);
}

}  // namespace dgorl::bindings
