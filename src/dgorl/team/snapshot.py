"""A team at one moment as a watcher sees it, as plain numbers: what ``dgorl monitor`` shows and writes as JSON."""

from __future__ import annotations

from collections.abc import Collection
from math import degrees, sqrt
from statistics import median
from typing import Any

from dgorl.team.bulletin import Bulletin
from dgorl.team.journal_schema import hexadecimal
from dgorl.team.report import Peer
from dgorl.team.team_file import TeamFile
from dgorl.team.watch import Seen, Watch


def snapshot(team: TeamFile, watch: Watch, present: Collection[str], now: float, nameless: int = 0) -> dict[str, Any]:
    """Everything of a team, ready for JSON. present: who is on the network; now: the watcher's clock [s].

    nameless: how many are there under names that no robot can have.

    ``clock.ahead_s``: of team time where clocks are estimated, else of the median of the robots heard.
    """
    clocks = clocks_ahead(team, watch, now)
    return {
        "team": team.team,
        "clock": team.configuration.clock,
        "robots": {robot: _robot(team, seen, robot in present, clocks, now) for robot, seen in watch.robots.items()},
        "strangers": sorted({*present, *watch.strangers} - set(team.robots)),
        "nameless": nameless or int(watch.nameless > 0),
    }


def clocks_ahead(team: TeamFile, watch: Watch, now: float) -> dict[str, tuple[float, float | None]]:
    """Robot heard → how far its clock is ahead [s], and its σ where that is estimated; without those not placed."""
    live = {robot: seen for robot, seen in watch.robots.items() if seen.live(now)}
    if team.configuration.clock == "estimated":
        placed = {robot: seen.bulletin.clocks.get(robot) for robot, seen in live.items() if seen.bulletin}
        return {robot: (-clock.offset, clock.sigma) for robot, clock in placed.items() if clock}
    ahead = {robot: seen.ahead for robot, seen in live.items() if seen.ahead is not None}
    middle = median(ahead.values()) if ahead else 0.0
    return {robot: (value - middle, None) for robot, value in ahead.items()}


def position_sigma(peer: Peer) -> float | None:
    """Root of the largest eigenvalue of a peer's position covariance [m]."""
    if peer.covariance is None:
        return None
    xx, xy, _, yy, _, _ = peer.covariance
    return sqrt(max((xx + yy) / 2 + sqrt((xx - yy) ** 2 / 4 + xy**2), 0.0))


def _robot(
    team: TeamFile, seen: Seen, present: bool, clocks: dict[str, tuple[float, float | None]], now: float
) -> dict[str, Any]:
    ahead, sigma = clocks.get(seen.robot, (None, None))
    same = None if seen.configuration is None else seen.configuration == team.configuration_hash
    return {
        "present": present,
        "heard_s_ago": None if seen.epoch is None else round(now - seen.heard, 2),
        "epoch": None if seen.epoch is None else hexadecimal(seen.epoch),
        "same_team_file": same,
        "clock": {"ahead_s": _rounded(ahead, 4), "sigma_s": _rounded(sigma, 4)},
        "rejected_here": dict(seen.rejected),
        "lives_twice": seen.rejects,
        "says": None if seen.bulletin is None else _bulletin(seen.bulletin, now - seen.told),
    }


def _bulletin(bulletin: Bulletin, since: float) -> dict[str, Any]:
    return {
        "s_ago": round(since, 2),
        "version": bulletin.version,
        "present": sorted(bulletin.present),
        "loss": {robot: round(share, 3) for robot, share in sorted(bulletin.losses.items())},
        "sent_bytes_per_s": bulletin.sent,
        "received_bytes_per_s": bulletin.received,
        "wire_bytes_per_s": bulletin.wire,
        "rejected": dict(bulletin.rejected),
        "tick_ms": round(1e3 * bulletin.tick, 2),
        "peers": {name: _peer(peer, since) for name, peer in sorted(bulletin.peers.items())},
    }


def _peer(peer: Peer, since: float) -> dict[str, Any]:
    heading = None if peer.covariance is None else degrees(sqrt(peer.covariance[5]))
    return {
        "status": str(peer.status),
        "pose": None if peer.pose is None else [round(value, 3) for value in peer.pose],
        "position_sigma_m": _rounded(position_sigma(peer), 3),
        "heading_sigma_deg": _rounded(heading, 2),
        "probability": round(peer.probability, 3),
        "age_s": None if peer.age is None else round(peer.age + since, 2),
        "reason": peer.reason,
        "resolve_by": peer.resolve_by,
    }


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
