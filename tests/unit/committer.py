"""A small agent for the journal's tests, and one to be killed.

It commits bundles as fast as it can and tells of each when it may be sent, of each tick when it is written.
"""

from __future__ import annotations

import os
from itertools import count
from multiprocessing.connection import Connection
from random import Random

from dgorl.measurements import Odometry
from dgorl.team.bundles import Bundle, Sealed, track_epoch
from dgorl.team.journal import Journal
from dgorl.team.keys import UNSIGNED, Roster
from dgorl.team.wire import seal

ROSTER = Roster("lab", {"r1": None, "r2": None, "r3": None}, insecure=True)


def made(robot: str, epoch: int, sequence: int, cut: float, v: float = 0.5) -> Sealed:
    """A bundle of one step of odometry."""
    step = Odometry(robot, cut - 0.5, cut, v, 0.1, track_epoch(epoch, 0))
    return seal(Bundle("lab", robot, epoch, sequence, 0, cut, (step,)), UNSIGNED)


def begun(path: str | os.PathLike[str], **changes: object) -> Journal:
    """r1's journal."""
    return Journal.open(path, "r1", ROSTER, **{"settings": {"window": 30.0}, "keep": 20.0, **changes})


def main(path: str, told: Connection) -> None:
    """Until killed."""
    journal, chance = begun(path), Random()
    began = 0.0 if journal.last is None else journal.last + 0.5
    for k in count():
        now = began + 0.5 * k
        own = made("r1", journal.epoch, journal.next_sequence, now, chance.random())
        journal.commit_own(own)
        told.send(("own", journal.epoch, own.bundle.sequence, own.data))
        received = made("r2", 7, round(2 * now), now)
        journal.receive(received)
        journal.tick(now, [own, received])
        journal.flush()
        told.send(("tick", now))
