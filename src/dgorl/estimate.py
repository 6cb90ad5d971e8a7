"""What a Localizer answers: every peer's relative pose with covariance and an honest status. METHOD §3."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

from dgorl.se2 import Array


class Status(StrEnum):
    """What is known of a peer."""

    ISOLATED = "isolated"
    AMBIGUOUS = "ambiguous"
    UNOBSERVABLE = "unobservable"
    POSITION = "position"
    TRACKED = "tracked"


@dataclass(frozen=True)
class PeerHypothesis:
    """One of the places an ambiguous peer may be: probability, pose (3,) and covariances (3, 3) as in PeerEstimate."""

    probability: float
    pose: Array
    covariance: Array
    tangent_covariance: Array | None = None


@dataclass(frozen=True)
class PeerEstimate:
    """One peer in the ego's body frame (x forward, y left) at the estimate's stamp.

    pose: (3,) of x, y, theta [m, m, rad], None while isolated or ambiguous without a guess. covariance: (3, 3) of
    (x, y, theta) in the ego's frame, as wide as the errors are: an uncertain bearing bends what is known of a position.
    tangent_covariance: (3, 3) of ξ in pose · Exp(ξ), to first order, for who fuses it.
    probability: of the best hypothesis. age: since its last odometry [s]. reason: why not tracked; resolve_by: what
    would help. hypotheses: while ambiguous, all that are alive, most probable first.
    """

    pose: Array | None
    covariance: Array | None
    status: Status
    probability: float
    age: float
    reason: str = ""
    resolve_by: str = ""
    hypotheses: tuple[PeerHypothesis, ...] = ()
    tangent_covariance: Array | None = None


@dataclass(frozen=True)
class Edge:
    """The newest measurement of one kind between two robots; residual in σ, weight 0 (outlier) to 1."""

    a: str
    b: str
    kind: str
    stamp: float
    residual: float
    weight: float


@dataclass(frozen=True)
class OptimizedGraph:
    """The paper's G_o = (V_o, E_o, A_o): poses (3,) in the ego's frame, edges, adjacency (n, n).

    ``adjacency`` counts the measurements of the window between each two of the robots, sorted by name.
    """

    poses: Mapping[str, Array]
    edges: tuple[Edge, ...]
    adjacency: Array


@dataclass(frozen=True)
class ClockState:
    """A robot's clock where clocks are estimated: team time = own time + offset [s], changing by drift [s/s].

    sigma: of the offset [s]. epoch: the clock's.
    """

    epoch: int
    offset: float
    drift: float
    sigma: float


@dataclass(frozen=True, eq=False)
class Estimate(Mapping[str, PeerEstimate]):
    """What ``robot`` knows of its peers at ``stamp`` [s]; a mapping from peer to PeerEstimate.

    rejected: measurements turned down since the start, by reason. clocks: of all robots placed, where they are
    estimated (``clock: estimated``).
    """

    robot: str
    stamp: float
    peers: Mapping[str, PeerEstimate]
    rejected: Mapping[str, int]
    _graph: Callable[[], OptimizedGraph] = field(repr=False, compare=False)
    clocks: Mapping[str, ClockState] = field(default_factory=lambda: MappingProxyType({}))

    def __getitem__(self, peer: str) -> PeerEstimate:
        try:
            return self.peers[peer]
        except KeyError:
            known = ", ".join(self.peers) or "nobody"
            raise KeyError(f"{self.robot} has heard of no robot {peer!r} until {self.stamp:g} s; of {known}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.peers)

    def __len__(self) -> int:
        return len(self.peers)

    @property
    def graph(self) -> OptimizedGraph:
        """The optimised graph behind this estimate."""
        return self._graph()
