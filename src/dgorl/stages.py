"""An optional stopwatch for the stages of Alg. 3: formation, expansion, optimisation.

No clock runs, and no estimate changes, unless a caller asks for one::

    with Stopwatch() as watch:
        localizer.update(now)
    watch.seconds["expansion"]
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar, Token
from typing import TypeVar

T = TypeVar("T")

FORMATION, EXPANSION, OPTIMISATION = STAGES = ("formation", "expansion", "optimisation")


class Stopwatch:
    """CPU seconds of this process by stage while entered; a stage inside another counts for itself alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        self._inside: list[str] = []
        self._since = 0.0
        self._token: Token[Stopwatch | None] | None = None

    def __enter__(self) -> Stopwatch:
        self._token = _RUNNING.set(self)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._token is not None
        _RUNNING.reset(self._token)

    def laps(self, ticks: Iterable[T], into: list[list[float]]) -> Iterator[T]:
        """The ticks, and after each of them the seconds of every stage so far appended to ``into``."""
        for tick in ticks:
            into.append([self.seconds[name] for name in STAGES])
            yield tick

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what happens inside for ``name``."""
        self._lap()
        self._inside.append(name)
        try:
            yield
        finally:
            self._lap()
            self._inside.pop()

    def _lap(self) -> None:
        now = time.process_time()
        if self._inside:
            self.seconds[self._inside[-1]] += now - self._since
        self._since = now


_RUNNING: ContextVar[Stopwatch | None] = ContextVar("stopwatch", default=None)
_UNTIMED = nullcontext()


def stage(name: str) -> AbstractContextManager[None]:
    """Marks a stage for the stopwatch that runs, if one does."""
    watch = _RUNNING.get()
    return _UNTIMED if watch is None else watch.stage(name)
