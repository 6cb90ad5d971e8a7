"""claims.md and claims.json: every claim of the paper, ours beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dgorl.evaluation.claims import Claim
from dgorl.evaluation.results import write_text

HEAD = ("claim", "paper", "ours", "spread", "trials", "ratio", "asked", "met", "note", "command")
INTRODUCTION = """\
# The paper's claims, measured

{trials} trials of the paper's setting: five robots in 60 × 60 m, {steps} steps of 0.5 s, random walk at 0.5 m/s, RSSI
with η = 3 and 2 dB, links up to 40 m; seeds from {seed}. With unknown starts a trial is {longer} times as long. Every
row comes from

    {command}

RMSE are pooled over robots, peers and the steps from {first} on; with unknown starts over located peers. Nothing is
aligned unless the row says so. Intervals are 95 % bootstraps over trials where the row names nothing else. “ratio” is
ours ÷ what stands beside it. CPU times are of this machine: {machine}.
"""


def write_claims(claims: Sequence[Claim], setting: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Write both files; returns what claims.json holds. setting: trials, steps, seed, command, first, machine."""
    found = {"setting": dict(setting), "claims": [asdict(claim) for claim in claims]}
    write_text(json.dumps(found, indent=2, ensure_ascii=False, allow_nan=False) + "\n", folder / "claims.json")
    write_text(markdown(claims, setting), folder / "claims.md")
    return found


def markdown(claims: Sequence[Claim], setting: Mapping[str, Any]) -> str:
    """The page: what was done, and a row a claim."""
    rows = [HEAD, ("---",) * len(HEAD), *(cells(claim) for claim in claims)]
    table = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    judged = [claim for claim in claims if claim.met is not None]
    missed = [claim.claim for claim in judged if not claim.met]
    verdict = f"Of {len(judged)} limits asked for, {len(judged) - len(missed)} are met."
    if missed:
        verdict += "\nNot met:\n\n" + "\n".join(f"- {name}" for name in missed)
    return "\n".join([INTRODUCTION.format(**setting), table, "", verdict, ""])


def cells(claim: Claim) -> tuple[str, ...]:
    """One row, as words."""
    spread = "–"
    if claim.low is not None and claim.high is not None:
        spread = f"{number(claim.low)} to {number(claim.high)}"
        spread += "" if claim.spread == Claim.spread else f" ({claim.spread})"
    share = "–" if claim.ratio is None else number(claim.ratio)
    if claim.against and claim.ratio is not None:
        share += f" of {claim.against}"
    met = {None: "–", True: "met", False: "**not met**"}[claim.met]
    ours = "–" if claim.value is None else f"{number(claim.value)} {claim.unit}".strip()
    return (claim.claim, claim.paper, ours, spread, str(claim.trials or "–"), share, claim.asked or "–", met,
            claim.note or "–", f"`{claim.command}`" if claim.command else "–")  # fmt: skip


def number(value: float) -> str:
    """Three digits, more before the point if there are."""
    size = abs(value)
    decimals = 0 if size >= 100 else 1 if size >= 10 else 2 if size >= 1 else 3
    return f"{value:.{decimals}f}"
