"""Thousands of lives of a team: does the estimator raise, is it pure, is it wrong of what is exact?

    python benchmarks/stateful.py --examples 2000

Each life is drawn by hypothesis out of the rules of tests/team_machine.py: at most 50 things happen to 2 to 4 robots.
Printed are how many lives there were, in how many the estimator raised, said something malformed, or differed by a bit
from one that was given the same measurements in another order and asked at other times; and of those in which all was
exact, in how many a located peer was off by more than 5σ and 1 m: calm ones, and ones with gaps and losses. Whatever
raised, was malformed or impure is printed as the calls that repeat it.
"""

from __future__ import annotations

import argparse
import time
import traceback
from collections import Counter

from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test
from tests.team_machine import TeamMachine

BATCH = 25
"""Lives drawn from one seed; the first that fails ends them."""


def batch(number: int, lives: int, steps: int, counts: Counter[str]) -> None:
    """Draw lives from one seed and count what came of them; what failed is printed."""

    class Counted(TeamMachine):
        def judge(self, wrong: list[str]) -> None:
            self.wrong = getattr(self, "wrong", False) or bool(wrong)

        def teardown(self) -> None:
            super().teardown()
            counts["lives"] += 1
            counts[f"lives {self.kind}"] += 1
            counts["measurements"] += len(self.life.given)
            counts[f"wrong {self.kind}"] += getattr(self, "wrong", False)

    try:
        run_state_machine_as_test(
            seed(number)(Counted),
            settings=settings(
                max_examples=lives,
                stateful_step_count=steps,
                deadline=None,
                database=None,
                phases=(Phase.generate,),
                suppress_health_check=list(HealthCheck),
            ),
        )
    except Exception as error:
        what = str(error)[:5] if isinstance(error, AssertionError) else "raised"
        counts["lives"] += 1
        counts["impure" if what == "impur" else "raised" if what == "raised" else "malformed"] += 1
        print(f"seed {number}:", *traceback.format_exception(error)[-1:], *getattr(error, "__notes__", []), sep="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=2000)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0, help="of the first batch")
    options = parser.parse_args()
    counts: Counter[str] = Counter(dict.fromkeys(("raised", "malformed", "impure"), 0))
    began, number = time.process_time(), options.seed
    while counts["lives"] < options.examples:
        batch(number, min(BATCH, options.examples - counts["lives"]), options.steps, counts)
        number += 1
        print(f"{dict(sorted(counts.items()))}, {time.process_time() - began:.0f} s CPU", flush=True)


if __name__ == "__main__":
    main()
