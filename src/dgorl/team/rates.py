"""Rates: how much of something may pass in a time."""

from __future__ import annotations


class Bucket:
    """A token bucket: ``rate`` a second, ``burst`` at once."""

    __slots__ = ("_at", "_level", "burst", "rate")

    def __init__(self, rate: float, burst: float) -> None:
        self.rate, self.burst = rate, burst
        self._level, self._at = burst, float("-inf")

    def level(self, now: float) -> float:
        """What may pass at ``now`` [s]."""
        if now > self._at:
            self._level = min(self.burst, self._level + (now - self._at) * self.rate)
            self._at = now
        return self._level

    def take(self, amount: float, now: float) -> bool:
        """Whether ``amount`` may pass; if so it does."""
        if self.level(now) < amount:
            return False
        self._level -= amount
        return True

    def charge(self, amount: float, now: float) -> None:
        """Let ``amount`` pass in any case; what follows waits for it."""
        self.level(now)
        self._level -= amount


class Losses:
    """Which share of a sender's messages does not arrive, from the numbers they carry, over the last twenty or so."""

    MODULUS = 128
    """Numbers of messages count up modulo this."""

    MOST = 32
    """So many are taken for lost at once at most: a robot that was started again begins with another number."""

    _FADES = 0.95

    __slots__ = ("_came", "_last", "_lost")

    def __init__(self) -> None:
        self._last: int | None = None
        self._came, self._lost = 0.0, 0.0

    def count(self, number: int) -> None:
        """A message of this number came."""
        self._came, self._lost = self._came * self._FADES + 1.0, self._lost * self._FADES
        ahead = 1 if self._last is None else (number - self._last) % self.MODULUS
        if ahead <= self.MODULUS // 2:
            self._lost += min(ahead - 1, self.MOST)
            self._last = number
        else:
            self._lost = max(0.0, self._lost - 1.0)

    @property
    def share(self) -> float:
        """In [0, 1)."""
        return self._lost / (self._lost + self._came) if self._came else 0.0
