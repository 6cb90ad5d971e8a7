"""How a robot learns that its epoch has ended: by its own signature under what it does not know. METHOD §6.

Whoever comes back with a journal that others have outlived goes on where nobody listens, or uses numbers a second time.
No peer is believed that says so: they hold bundles that nobody but this robot's key can have signed, and send one.
"""

from __future__ import annotations

from math import inf

from dgorl.team.bundles import Bundle
from dgorl.team.rates import Bucket

QUIET = 3.0
"""Another machine under this robot's name has ended when nothing new of it has come for so long [s]."""

BURST, PAUSE = 3, 60.0
"""So many new epochs at once, and one more after each so many seconds."""

EPOCHS = 64
"""Of so many other epochs of the robot it is remembered how far they went."""

COPY = "the journal is an older copy: others hold bundles of this epoch that it does not know"
OUTLIVED = "the robot has lived in a later epoch since: this journal is not the one it was last run with"


class Witness:
    """What the robot's own signature proves. It outlives epochs: a proof serves once.

    born: when the epoch began [s], the robot's clock; an earlier epoch has no bundle cut later. made: numbers below
    this were used before the program began, by this journal. began: when the program began, or the epoch if that was
    later [s]. Times are on the robot's clock.
    """

    def __init__(self) -> None:
        self._bucket = Bucket(1.0 / PAUSE, BURST)
        self._highest: dict[int, int] = {}
        self.begin()

    def begin(self, born: float = inf, made: int = 0, began: float = -inf) -> None:
        """An epoch begins."""
        self._born, self._made, self._began = born, made, began
        self._copied = False
        self._heard: float | None = None
        self._lives = False

    def knows(self, sequence: int) -> bool:
        """Whether a bundle of the own epoch that is not here may be one that this journal lost."""
        return sequence < self._made

    def copied(self) -> None:
        """The own epoch has a bundle that was not made here."""
        self._copied = True

    def lived(self, bundle: Bundle, now: float) -> bool:
        """A bundle of another epoch of this robot; whether it tells of a life after the own epoch's beginning."""
        if bundle.cut <= self._born:
            return False
        if bundle.sequence > self._highest.get(bundle.epoch, -1):
            self._highest[bundle.epoch] = bundle.sequence
            if len(self._highest) > EPOCHS:
                del self._highest[next(iter(self._highest))]
            self._heard = now
            self._lives |= bundle.cut >= self._began
        return True

    def twin(self, now: float) -> bool:
        """Whether another machine lives under this robot's name: then that one counts, until it is silent."""
        return self._lives and not self._copied and self._heard is not None and now - self._heard < QUIET

    def ended(self, now: float) -> str:
        """Why a new epoch has to begin now; empty while none has to, or may."""
        why = COPY if self._copied else OUTLIVED if self._heard is not None and not self.twin(now) else ""
        return why if why and self._bucket.take(1.0, now) else ""
