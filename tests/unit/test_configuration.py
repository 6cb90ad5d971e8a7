"""Settings out of their range are refused, by name."""

from __future__ import annotations

import pytest

from dgorl import Configuration
from dgorl.configuration import merge
from dgorl.errors import ConfigurationError


@pytest.mark.parametrize(
    ("section", "changes", "message"),
    [
        ("ranging", {"scale": 0}, "ranging.scale must be positive"),
        ("ranging", {"sigma": 0.1, "sigma_per_metre": -0.01}, "ranging.sigma_per_metre must be at least 0"),
        *((section, {"thinning": -1}, "thinning must be at least 0") for section in ("radio", "ranging", "bearings")),
    ],
)
def test_what_no_sensor_does_is_refused(section: str, changes: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=f"file: {message}"):
        merge(Configuration(), {section: changes}, "file")
