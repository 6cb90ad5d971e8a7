"""A live team of real agents on loopback, through what can go wrong: what was asked, what came of it.

    python benchmarks/live.py --data DATA --out out/live [--only kill clocks] [--short]

Every row runs ``dgorl fleet``, one agent process a robot, one after another; an hour in all on two idle cores. Times
are the log's: a fleet at 4 × passes four of them a second. A machine too slow for that skips ticks, never data. The
table is added to as rows come, and left in ``live.md``.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

from live_clocks import clocks
from live_fleet import ROOT, Place, Row
from live_kills import kill
from live_lives import churn
from live_network import line, loss50, loss90, lossless, partition, recomputed
from live_traffic import traffic

ROWS: dict[str, Callable[[Place], Iterator[Row]]] = {
    "lossless": lossless,
    "loss50": loss50,
    "loss90": loss90,
    "line": line,
    "partition": partition,
    "kill": kill,
    "churn": churn,
    "clocks": clocks,
    "traffic": traffic,
    "recompute": recomputed,
}


def main() -> None:
    """Run the rows, print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT / "data", help="where the folder mrclam6 is")
    parser.add_argument("--out", type=Path, default=Path("out/live"))
    parser.add_argument("--only", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--short", action="store_true", help="less of everything, to try it")
    options = parser.parse_args()
    place = Place(options.out, options.data, options.short)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # no agent stays behind
    options.out.mkdir(parents=True, exist_ok=True)
    good = True
    with (options.out / "live.md").open("w", encoding="utf-8") as file:
        _write(file, "| row | asked | measured | as asked | command |\n|---|---|---|---|---|")
        for name in options.only:
            began = time.monotonic()
            for row in ROWS[name](place):
                words = (name, row.asked, row.measured, "yes" if row.good else "NO", row.command)
                _write(file, f"| {' | '.join(word.replace('|', '¦') for word in words)} |")
                good = good and row.good
            print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr)
    sys.exit(not good)


def _write(file: TextIO, line: str) -> None:
    print(line, flush=True)
    print(line, file=file, flush=True)


if __name__ == "__main__":
    main()
