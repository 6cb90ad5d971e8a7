"""The row of ``live.py`` that counts bytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from live_fleet import Place, Row, ran, simulated

from dgorl.team.report import Report

ASKED = 2000
"""Of 5 robots that all hear all [B/s]."""
MEETING = 5.0
"""Traffic counts from this long after the first report [s]."""


def traffic(place: Place) -> Iterator[Row]:
    """Bytes by team and topology. A short window: what travels is the same, and 20 agents share two cores."""
    folder = place.folder("traffic")
    for robots in (5,) if place.short else (5, 10, 20):
        log = simulated(folder / f"log{robots}", 30.0, robots=robots, sensors="rssi")
        for shape in ("full", "line", "ring"):
            words = ("--initial", "known", "--window", 5, "--rate", 1 if robots < 20 else 0.5, "--topology", shape)
            left = ran(folder / f"{robots}-{shape}", log, *words)
            payload, wire, bundles = np.array([_rates(said) for said in left.reports.values()]).T
            binding = robots == 5 and shape == "full"
            yield Row(
                f"5 robots at 2 Hz: at most {ASKED} B/s of payload each" if binding else "–",
                f"{robots} robots, {shape}: payload {payload.mean():.0f} B/s (most {payload.max():.0f}), wire "
                f"{wire.mean():.0f} ({wire.max():.0f}), {bundles.mean():.1f} bundles/s; {left.skipped:.0%} ticks lost",
                left.said,
                payload.max() <= ASKED or not binding,
            )


def _rates(said: Sequence[Report]) -> tuple[float, float, float]:
    """Bytes of payload, bytes on the wire and bundles a second, while the log lasts."""
    said = [report for report in said if not report.final and report.stamp >= said[0].stamp + MEETING]
    a, b, seconds = said[0].traffic, said[-1].traffic, said[-1].stamp - said[0].stamp
    wire = np.nan if a.wire_bytes is None or b.wire_bytes is None else b.wire_bytes - a.wire_bytes
    return (b.sent_bytes - a.sent_bytes) / seconds, wire / seconds, (b.bundles - a.bundles) / seconds
