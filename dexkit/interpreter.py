"""Settings of the Python interpreter for processes whose threads have deadlines."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["SWITCH_INTERVAL", "timely_threads"]

SWITCH_INTERVAL = 0.5e-3
"""Seconds after which a thread hands the interpreter over to one that waits for it. Python's own
5 ms are two and a half periods of a Dex1-1's state."""


@contextmanager
def timely_threads() -> Iterator[None]:
    """Shorten the pauses that the interpreter itself causes to its threads.

    Threads hand it over after :data:`SWITCH_INTERVAL`, and the objects that are there already are
    left out of garbage collection: to look through those of pytest and NumPy takes some 0.1 s, in
    which no thread runs.
    """
    before = sys.getswitchinterval()
    frozen = gc.get_freeze_count() > 0
    sys.setswitchinterval(min(SWITCH_INTERVAL, before))
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        if not frozen:
            gc.unfreeze()
        sys.setswitchinterval(before)
