"""Settings of the Python interpreter for processes whose threads have deadlines."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["SWITCH_INTERVAL", "pause_collection", "shorten_pauses", "timely_threads"]

SWITCH_INTERVAL = 0.5e-3
"""Seconds after which a thread hands the interpreter over to one that waits for it. Python's own
5 ms are two and a half periods of a Dex1-1's state."""


def shorten_pauses(switch_interval: float) -> None:
    """Shorten the pauses that the interpreter itself causes to its threads, for good.

    The objects that are there already are left out of garbage collection: to look through those of
    pytest and NumPy takes some 0.1 s, in which no thread runs.

    :param switch_interval: seconds after which a thread hands the interpreter over.
    """
    sys.setswitchinterval(switch_interval)
    gc.collect()
    gc.freeze()


@contextmanager
def timely_threads() -> Iterator[None]:
    """:func:`shorten_pauses` to :data:`SWITCH_INTERVAL`, and put back what was before at the end.

    A caller's shorter interval stays, and so does what it has left out of garbage collection.
    """
    before = sys.getswitchinterval()
    frozen = gc.get_freeze_count() > 0
    shorten_pauses(min(SWITCH_INTERVAL, before))
    try:
        yield
    finally:
        if not frozen:
            gc.unfreeze()
        sys.setswitchinterval(before)


@contextmanager
def pause_collection() -> Iterator[None]:
    """No garbage collection for the time of a calculation that makes many objects and few cycles.

    To look through the objects of a recording again and again takes a tenth of its judgement.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
