"""Who is heard: neighbours, whose epochs are admitted, and callers, whose are not yet; and how much of it gets lost."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dgorl.team.bundles import Name
from dgorl.team.messages import Message
from dgorl.team.neighbours import Neighbour

WELL = 0.7
"""Who loses a larger share of a neighbour's messages does not hear it, for those who might relay."""


class Circle:
    """The robots around one robot, by name."""

    def __init__(self) -> None:
        self.neighbours: dict[str, Neighbour] = {}
        self.callers: dict[str, Neighbour] = {}

    def hear(self, message: Message, now: float) -> bool:
        """A neighbour is there, in its current epoch; True if it is new or was away."""
        neighbour = self.neighbours.get(message.robot)
        new = neighbour is None or neighbour.key != message.key
        if neighbour is None or new:
            caller = self.callers.pop(message.robot, None)
            neighbour = caller if caller is not None and caller.key == message.key else Neighbour(message.key)
            self.neighbours[message.robot] = neighbour
        return neighbour.hear(message.number, now) or new

    def call(self, message: Message, now: float) -> None:
        """Somebody is there whose epoch is not admitted."""
        caller = self.callers.get(message.robot)
        if caller is None or caller.key != message.key:
            caller = self.callers[message.robot] = Neighbour(message.key)
        caller.hear(message.number, now)

    def live(self, now: float) -> dict[str, Neighbour]:
        """Neighbours heard lately."""
        return {robot: n for robot, n in self.neighbours.items() if n.live(now)}

    def heard_well(self, now: float) -> list[str]:
        """Neighbours whose messages need not be passed on to us; others' relays fill in for the rest."""
        return sorted(robot for robot, n in self.live(now).items() if n.losses.share <= WELL)

    def calling(self, now: float) -> list[Neighbour]:
        """Callers heard lately."""
        return [caller for caller in self.callers.values() if caller.live(now)]

    def met(self) -> int:
        """How many robots were heard at all."""
        return len(self.neighbours.keys() | self.callers.keys())

    def holders(self, name: Name, now: float) -> Sequence[str]:
        """Neighbours that hold a bundle."""
        return sorted(robot for robot, n in self.live(now).items() if n.has(name))

    def relays(self, name: Name, sender: str, robot: str, now: float) -> bool:
        """Whether it is ``robot``'s turn to pass on what came from ``sender``, for a neighbour that may lack it."""
        live = self.live(now)
        for other, neighbour in live.items():
            if other in (sender, name.robot) or sender in neighbour.hears or neighbour.has(name):
                continue
            able = [r for r, n in live.items() if r in neighbour.hears and (sender in n.hears or r == sender)]
            able = sorted({*able, robot} if robot in neighbour.hears else able)
            if able and able[name.sequence % len(able)] == robot:
                return True
        return False

    def losses(self, now: float) -> dict[str, float]:
        """Which share of each neighbour's messages does not arrive."""
        return {robot: n.losses.share for robot, n in self.live(now).items()}

    def loss(self, now: float) -> float:
        """... on average."""
        return _mean(self.losses(now).values())

    def loss_to_bear(self, now: float) -> float:
        """... of callers' messages, too; or to the worst heard of those that are behind, if that is more."""
        live, calling = self.live(now).values(), self.calling(now)
        behind = (neighbour.losses.share for neighbour in live if neighbour.behind(now))
        return max(_mean(neighbour.losses.share for neighbour in [*live, *calling]), *behind, 0.0)


def _mean(shares: Iterable[float]) -> float:
    known = list(shares)
    return sum(known) / len(known) if known else 0.0
