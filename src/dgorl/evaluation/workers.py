"""Trials on several processes, or on a Dask cluster; each trial is computed alike wherever that is."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from threading import Thread
from typing import Any, TypeVar

from dgorl.errors import DgorlError, MissingExtraError, pip_install

A = TypeVar("A")
B = TypeVar("B")

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""one thread a worker: a trial's matrices are small, and how sums are split over threads would show in last digits"""


def on_processes(run: Callable[[A], B], tasks: Sequence[A], workers: int) -> Iterator[tuple[A, B]]:
    """Each task with its result as they are done. Processes are spawned, and ended if the caller stops early."""
    with (
        single_threaded(),
        ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_begin) as pool,
    ):
        running = {pool.submit(run, task): task for task in tasks}
        try:
            for future in as_completed(running):
                yield running[future], future.result()
        except BaseException:
            # Not pool.shutdown(wait=False): nobody would wait for its threads, which write to queues that are gone.
            for future in running:
                future.cancel()
            for child in multiprocessing.active_children():
                child.terminate()
            raise


def on_cluster(run: Callable[[A], B], tasks: Sequence[A], address: str) -> Iterator[tuple[A, B]]:
    """The same on the Dask cluster whose scheduler listens at ``address``. Raises MissingExtraError, DgorlError."""
    try:
        import distributed
    except ImportError as error:
        raise MissingExtraError(f"a cluster needs Dask: {pip_install('distributed')}") from error
    dask: Any = distributed
    try:
        client = dask.Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise DgorlError(f"--cluster {address}: no Dask scheduler answers there ({error}); start one with"
                         " `dask scheduler`, workers with `dask worker ADDRESS --nthreads 1`") from error  # fmt: skip
    with client:
        futures = {client.submit(run, task, pure=False): task for task in tasks}
        try:
            for future, result in dask.as_completed(futures, with_results=True):
                yield futures[future], result
        finally:
            client.cancel(list(futures))


@contextmanager
def single_threaded() -> Iterator[None]:
    """What is started meanwhile computes on one thread."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value


def _begin() -> None:
    """Leave Ctrl-C, which reaches every process of a terminal, to the one that waits for these; end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
