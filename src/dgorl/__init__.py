"""DGORL: where are the others? Relative localization of robot teams by distributed graph optimization."""

from dgorl.configuration import Configuration
from dgorl.errors import DgorlError
from dgorl.estimate import Estimate, PeerEstimate, Status
from dgorl.localizer import Localizer, Team
from dgorl.measurements import WORLD, Bearing, Displacement, Odometry, Range, RelativePose, Rssi

__version__ = "0.1.0"
__all__ = [
    "WORLD",
    "Bearing",
    "Configuration",
    "DgorlError",
    "Displacement",
    "Estimate",
    "Localizer",
    "Odometry",
    "PeerEstimate",
    "Range",
    "RelativePose",
    "Rssi",
    "Status",
    "Team",
    "__version__",
]
