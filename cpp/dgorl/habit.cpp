#include "dgorl/habit.hpp"

#include <algorithm>
#include <cmath>

namespace dgorl {
namespace {

using Array = Habit::Array;

constexpr double kShortest = 0.25;   // shorter samples say little of the next [s]
constexpr double kUsual = 0.5;       // length of a sample while none is known [s]
constexpr double kPersisting = 4.0;  // what the errors over so long have in common persists [s]
constexpr double kPriorPairs = 4.0;  // the configured sigmas count like so many pairs of samples
constexpr std::size_t kFewest = 3;   // pairs to learn from
constexpr double kTiny = 1e-12;      // [m^2/s^2, rad^2/s^2] who never changed keeps on

struct Pair {
  Array last, next;  // twist of a sample's last row, mean twist of the sample after it
  int run;           // how many pairs in a row end here
};

// Variance of the mean over `count` samples, beyond what shocks make of it.
Array persisting(const std::vector<Pair>& pairs, const Habit& habit, int count) {
  Array gain = Array::Zero(), shocks = Array::Zero();
  for (int j = 0; j < count; ++j) {
    gain = gain * habit.keep + 1.0;
    shocks += gain.square();
  }
  gain *= habit.keep / count;
  shocks *= habit.shock / (static_cast<double>(count) * count);
  Array sum = Array::Zero(), squares = Array::Zero();
  int windows = 0;
  for (std::size_t k = 0; k < pairs.size(); ++k) {
    if (pairs[k].run == 1) sum.setZero();
    sum += pairs[k].next;
    if (pairs[k].run > count) sum -= pairs[k - count].next;
    if (pairs[k].run < count) continue;
    const Array deviation = pairs[k + 1 - count].last - habit.mean;
    squares += (sum / count - habit.mean - gain * deviation).square();
    ++windows;
  }
  if (windows < count) return Array::Zero();
  return squares * (1.0 / windows + count / (static_cast<double>(windows) * windows)) - shocks;
}

void learn(Habit& habit, const std::vector<Pair>& pairs) {
  const double n = static_cast<double>(pairs.size());
  Array mean = Array::Zero(), from = Array::Constant(kTiny), both = from, rest = Array::Zero();
  for (const Pair& pair : pairs) mean += pair.next;
  mean /= n;
  for (const Pair& pair : pairs) {
    from += (pair.last - mean).square();
    both += (pair.last - mean) * (pair.next - mean);
  }
  habit.mean = mean;
  habit.keep = (both / from).max(0.0).min(1.0);
  for (const Pair& pair : pairs) rest += (pair.next - mean - habit.keep * (pair.last - mean)).square();
  habit.shock = rest / (n - 2.0);
  const int count = std::max(2, static_cast<int>(std::lround(kPersisting / habit.length)));
  const double unknown = kPriorPairs / (n + kPriorPairs);
  habit.drift = (habit.drift * unknown * unknown).max(persisting(pairs, habit, count));
}

}  // namespace

void DriveRecord::append(const Step& step, bool measured) {
  if (!measured) {
    open_ = Sample();
    return;
  }
  if (open_.end <= open_.start) open_.start = step.start;
  open_.end = step.end;
  const Vector3 motion = log(step.delta);
  open_.mean += motion;
  open_.last = motion / (step.end - step.start);
  open_.position += 0.5 * (step.covariance(0, 0) + step.covariance(1, 1));
  open_.heading += step.covariance(2, 2);
  if (keyframe_before(step.end + kRounding) == keyframe_before(step.start + kRounding)) return;
  open_.mean /= open_.end - open_.start;
  samples_.push_back(open_);
  open_ = Sample();
}

void DriveRecord::forget(double stamp) {
  samples_.erase(samples_.begin(), std::find_if(samples_.begin(), samples_.end(),
                                                [stamp](const Sample& s) { return s.end > stamp; }));
}

Habit DriveRecord::habit(const Vector3& twist, double from, double stamp, const MotionModel& m) const {
  const Array prior(m.predicted_speed_sigma, m.predicted_speed_sigma, m.predicted_turn_rate_sigma);
  Habit habit{twist.array(),
              Array::Ones(),
              Array::Zero(),
              prior.square(),
              kUsual,
              square(m.position_per_second),
              square(m.heading_per_second)};
  std::vector<Pair> pairs;
  double time = 0.0, position = 0.0, heading = 0.0;
  int used = 0, run = 0;
  const Sample* before = nullptr;
  const auto first = std::lower_bound(samples_.begin(), samples_.end(), stamp - kLearnt,
                                      [](const Sample& s, double t) { return s.start < t; });
  for (auto sample = first; sample != samples_.end() && sample->end <= from; ++sample) {
    if (sample->end - sample->start < kShortest) continue;
    run = before && sample->start <= before->end ? run + 1 : 0;
    if (run) pairs.push_back({before->last, sample->mean, run});
    before = &*sample;
    time += sample->end - sample->start;
    position += sample->position;
    heading += sample->heading;
    ++used;
  }
  if (pairs.size() < kFewest) return habit;
  habit.length = time / used;
  habit.position = position / time;
  habit.heading = heading / time;
  learn(habit, pairs);
  return habit;
}

}  // namespace dgorl
