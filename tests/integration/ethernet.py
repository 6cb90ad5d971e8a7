"""An Ethernet between network namespaces, in a thread: frames get lost and come late, whatever is in them.

Like ``tc netem`` on a bridge, which few kernels have.
"""

from __future__ import annotations

import heapq
import os
import select
import shutil
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from itertools import count
from pathlib import Path
from random import Random

from . import namespaced

FRAME = 65536


class Ethernet:
    """A frame goes to all other ports; each copy is lost with probability ``loss`` or comes ``delay`` [s] late.

    path: of the Unix socket where ports come from.
    """

    def __init__(self, path: Path, loss: float, delay: tuple[float, float], seed: int = 0) -> None:
        self.carried = self.lost = 0
        self._path, self._loss, self._delay, self._random = path, loss, delay, Random(seed)
        self._door = socket.socket(socket.AF_UNIX)
        self._door.bind(str(path))
        self._door.listen()
        self._ports: list[int] = []
        self._late: list[tuple[float, int, int, bytes]] = []
        self._numbers = count()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def command(self, address: str, *words: str) -> list[str]:
        """What runs ``words`` in a namespace of its own at this address, like 10.0.0.1/24."""
        return ["unshare", "-rn", sys.executable, namespaced.__file__, str(self._path), address, *words]

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._door.close()
        for port in self._ports:
            os.close(port)

    def _run(self) -> None:
        while not self._closing.is_set():
            ready, _, _ = select.select([self._door, *self._ports], [], [], self._wait())
            for source in ready:
                if source is self._door:
                    self._admit()
                else:
                    self._hear(source)
            while self._late and self._late[0][0] <= time.monotonic():
                _, _, port, frame = heapq.heappop(self._late)
                with suppress(OSError):  # its namespace may be gone
                    os.write(port, frame)

    def _wait(self) -> float:
        return min(max(self._late[0][0] - time.monotonic(), 0.0), 0.1) if self._late else 0.1

    def _admit(self) -> None:
        visitor, _ = self._door.accept()
        with visitor:
            _, ports, _, _ = socket.recv_fds(visitor, 16, 1)
        self._ports += ports

    def _hear(self, source: int) -> None:
        frame = os.read(source, FRAME)
        for port in self._ports:
            if port == source:
                continue
            if self._random.random() < self._loss:
                self.lost += 1
            else:
                self.carried += 1
                due = time.monotonic() + self._random.uniform(*self._delay)
                heapq.heappush(self._late, (due, next(self._numbers), port, frame))


def missing(folder: Path) -> str:
    """What this machine lacks to make network namespaces with an Ethernet; empty when it has all."""
    for program in ("unshare", "ip"):
        if shutil.which(program) is None:
            return f"no program `{program}`"
    ethernet = Ethernet(folder / "trial", 0.0, (0.0, 0.0))
    try:
        done = subprocess.run(ethernet.command("10.0.0.1/24"), capture_output=True, text=True, timeout=20, check=False)
    finally:
        ethernet.close()
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""
