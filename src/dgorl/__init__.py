"""DGORL: where are the others? Relative localization of robot teams by distributed graph optimization."""

from dgorl.errors import DgorlError
from dgorl.measurements import WORLD, Bearing, Displacement, Odometry, Range, RelativePose, Rssi

__version__ = "0.1.0"
__all__ = [
    "WORLD",
    "Bearing",
    "DgorlError",
    "Displacement",
    "Odometry",
    "Range",
    "RelativePose",
    "Rssi",
    "__version__",
]
