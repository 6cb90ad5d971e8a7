"""How a process that runs for days keeps small."""

from __future__ import annotations

import ctypes
import gc

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""glibc's names of these settings, in malloc.h."""
LARGE = 128 * 1024
"""Arrays from this size on [bytes] come from the system and go back to it at once."""


def keep_small() -> None:
    """Call it once, when all is imported.

    glibc's own thresholds grow with every large array that is freed, up to 32 MB; what is freed between small objects
    that live on is then kept for ever, and an agent grows by a third. Other systems' allocators need nothing.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    for name, value in ((M_MMAP_THRESHOLD, LARGE), (M_TRIM_THRESHOLD, LARGE), (M_ARENA_MAX, 1)):
        mallopt(name, value)
    gc.collect()
    gc.freeze()  # what is imported stays: no need to look through it again and again
