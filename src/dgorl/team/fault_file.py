"""What goes wrong on the network, as one file tells a fleet's agents: JSON."""

from __future__ import annotations

from pathlib import Path

import msgspec

from dgorl.errors import ConfigurationError
from dgorl.team.faults import Faults, Partition, Topology, topology


class Parted(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """From ``start`` to ``end`` [s of the recording] only robots of one group hear one another."""

    groups: tuple[tuple[str, ...], ...]
    start: float
    end: float


class FaultFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fields of :class:`dgorl.team.faults.Faults`; ``topology`` is of ``robots`` in this order."""

    robots: tuple[str, ...]
    seed: int = 0
    loss: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)
    duplicate: float = 0.0
    reorder: float = 0.0
    partitions: tuple[Parted, ...] = ()
    topology: Topology = "full"

    def faults(self) -> Faults:
        """What they do to a transport."""
        parted = (Partition(tuple(map(frozenset, p.groups)), p.start, p.end) for p in self.partitions)
        reaches = topology(self.topology, self.robots)
        return Faults(self.seed, self.loss, self.delay, self.duplicate, self.reorder, tuple(parted), reaches)

    def write(self, path: Path) -> None:
        """As a file."""
        path.write_bytes(msgspec.json.encode(self))


def read_faults(path: Path) -> Faults:
    """What a file says. Raises ConfigurationError."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=FaultFile).faults()
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error
    except msgspec.MsgspecError as error:
        raise ConfigurationError(f"{path}: {error}") from error
