"""What is known of a peer, why not more, and what would help: METHOD §3, Status.

Status follows the posterior alone; the words come from its weak directions and from the motion that would tell most.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees, hypot, isfinite, radians, sqrt

import numpy as np

from dgorl import _core, se2
from dgorl.configuration import Configuration
from dgorl.estimate import PeerHypothesis, Status
from dgorl.expansion.hypotheses import Motion
from dgorl.history import DEFAULT_RANGE_SIGMA, History
from dgorl.observability_motion import MIRROR, Limits, resolve_by, weak_directions
from dgorl.radio import relative_sigma
from dgorl.relative import Relative, bent, first_order
from dgorl.se2 import Array
from dgorl.tracks import HELD, KEYFRAMES_PER_SECOND, Track

UNKNOWN = 1e-6
"""Added to information matrices [1/m²]: where nothing is known, little is."""

OWN_LATENESS = 1.0
"""So late [s] a robot's own odometry may be without a peer being called less well known: it is on its way."""

CRUISE = 0.5
"""Speed of proposed motions where the configuration allows more [m/s]."""


def joined_status(ego: str, pose: Array, covariance: Array, configuration: Configuration) -> tuple[Status, str]:
    """Status of a joined peer and why it is not tracked."""
    limits = configuration.status
    (x, y, _), ((a, b, _), (_, d, _), (_, _, t)) = pose.tolist(), covariance.tolist()
    sigma = sqrt(max((a + d) / 2 + sqrt(((a - d) / 2) ** 2 + b * b), 0.0))
    accuracy = max(limits.accuracy, limits.accuracy_per_metre * hypot(x, y))
    heading = degrees(sqrt(max(t, 0.0)))
    if not (isfinite(sigma) and isfinite(heading)) or sigma > accuracy:
        weak = ", ".join(weak_directions(ego, pose, covariance, accuracy, radians(limits.heading)))
        return Status.UNOBSERVABLE, f"position 1σ {sigma:.2f} m exceeds {accuracy:.2f} m: {weak} not known well enough"
    if heading > limits.heading:
        return Status.POSITION, f"heading 1σ {heading:.0f}° exceeds {limits.heading:.0f}°"
    return Status.TRACKED, ""


def own_part(history: History, own: Track, now: float) -> Array | None:
    """Covariance (3, 3) in the ego's own tangent of its motion up to ``now`` [s] that its odometry has yet to tell.

    None where it has told all, and where it is so late that it may not come.
    """
    late = now - own.core.known(now)
    return own.core.foreseen(now, history.motion) if 0.0 < late <= OWN_LATENESS else None


def without_own(seen: Relative, part: Array) -> Array:
    """Covariance (3, 3) of (x, y, theta) of a peer, as if that part of the ego's motion were known."""
    back = se2.adjoint(se2.inverse(seen.pose))
    return bent(seen.pose, first_order(seen.pose, seen.tangent - back @ part @ back.T))


def turned_since(history: History, peer: Track, covariance: Array, now: float) -> bool:
    """Whether a heading, of covariance (3, 3), is unknown only as the peer has yet to tell its way to ``now`` [s]."""
    if peer.core.known(now) >= now:
        return False
    rest = covariance[2, 2] - peer.core.foreseen(now, history.motion)[2, 2]
    return bool(rest <= radians(history.configuration.status.heading) ** 2)


def ambiguous_reason(places: tuple[PeerHypothesis, ...], motion: Motion, passing: tuple[str, str] | None = None) -> str:
    """Why a peer is not joined, in words that do not change with every tick; passing: who have met, if that is why."""
    if motion == "still":
        return "no robot has moved: ranges alone do not tell where it is"
    if motion == "straight":
        return f"{MIRROR} not known: every robot has driven straight"
    if motion == "uncertain":
        return f"{MIRROR} not known: odometry is too uncertain to tell how the robots drove"
    if passing is not None:
        return f"{passing[0]} and {passing[1]} have passed one another: on which side is not known yet"
    return "several places fit" if len(places) > 1 else "one place fits, not yet for long enough to be sure"


def after_gap(history: History, tracks: Sequence[Track], reason: str) -> str:
    """The reason, with why these tracks have to be placed anew: a gap or a jump of a robot's odometry before one."""
    for track in tracks:
        name, trail = track.key.robot, history.trails[track.key.robot].tracks
        last = next((t for t in reversed(trail) if t.key.begin < track.key.begin), None)
        if last is None or last.key.epoch != track.key.epoch:
            continue
        silent = track.key.begin - last.end
        if silent > HELD:
            return f"no odometry from {name} for {silent:.1f} s until {track.key.begin:.1f} s: {reason}"
        return f"odometry of {name} faster than its limits at {last.end:.1f} s: {reason}"
    return reason


def inconsistent(robot: str) -> tuple[str, str]:
    """What is said of a robot that does not fit, and what would help."""
    reason = f"inconsistent: {robot} does not move as its odometry says, or its readings are wrong"
    return reason, f"wait: {robot} is located anew if this goes on"


def advice(history: History, own: Track, peer: Track, pose: Array, covariance: Array, now: float, mirror: bool) -> str:
    """The motion that would tell most of a peer's pose (3,), known with covariance (3, 3) in the ego's frame."""
    configuration = history.configuration
    information = np.linalg.inv(covariance + UNKNOWN * np.eye(3))
    sigma, per_metre = _range_sigma(history)
    motion = configuration.motion
    found = resolve_by(
        (own.key.robot, peer.key.robot),
        pose,
        (information + information.T) / 2,
        sigma,
        limits=Limits(min(motion.maximum_speed, CRUISE), min(motion.maximum_turn_rate, 1.0)),
        twists=(_twist(own, now), _twist(peer, now)),
        range_sigma_per_metre=per_metre,
        mirror=mirror,
    )
    return found or f"{own.key.robot}: drive a circle"


def _twist(track: Track, now: float) -> tuple[float, float]:
    """v [m/s] and ω [rad/s] over the newest keyframe interval, zero before there is one."""
    newest = track.core.newest(now)
    if newest <= track.core.first:
        return 0.0, 0.0
    delta, _ = _core.odometry([track.core], [newest - 1], [newest])
    return float(delta[0, 0]) * KEYFRAMES_PER_SECOND, float(delta[0, 2]) * KEYFRAMES_PER_SECOND


def _range_sigma(history: History) -> tuple[float, float]:
    """σ of a range between robots: constant part [m] and share of the distance, of the best sensor in use."""
    ranging = history.configuration.ranging
    if len(history.tables["range"]) or not len(history.tables["rssi"]):
        return ranging.sigma or DEFAULT_RANGE_SIGMA, ranging.sigma_per_metre
    return UNKNOWN, relative_sigma(history.configuration.radio)
