"""Prepare a process for deadlines: timers, priorities, and real-time where permitted."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from dexkit.interpreter import shorten_pauses

__all__ = ["go_first", "precise_timers", "prepare_process", "real_time"]

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
# seconds; Python's default of 5 ms is two and a half periods of a Dex1-1's state
_SWITCH_INTERVAL = 50e-6
# With more hands than one, several threads wait for the interpreter, each wakes as often to ask
# for it, and they spend the time of two processors on that (two Dex3-1 at 1000 Hz). Their turns
# last 0.3 ms at most, so that it need not be asked for.
_SWITCH_INTERVAL_SHARED = 1e-3
# the lowest (and one above it for deadlines): ahead of ordinary processes, behind all else
_RR_PRIORITY = 1


@contextmanager
def real_time() -> Iterator[bool]:
    """Run this thread, and those it starts meanwhile, before ordinary processes.

    Yields whether the kernel permits it: to root, and to users with an rtprio limit. Elsewhere
    nothing changes. The service sleeps most of the time, and the kernel keeps 5 % for others in
    any case.
    """
    if sys.platform != "linux":
        yield False
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_RR_PRIORITY))
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, *before)


def go_first() -> None:
    """Raise this thread above the process's other threads, if they have real-time priority.

    Use it for the thread with deadlines: the others run while it sleeps.
    """
    if sys.platform == "linux" and os.sched_getscheduler(0) == os.SCHED_RR:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_RR_PRIORITY + 1))


def precise_timers() -> None:
    """Reduce the calling thread's timer slack, so that its sleeps end on time.

    Linux may delay a wake-up by the thread's timer slack, 50 us by default, to save power.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)


def prepare_process(hands: int = 1) -> None:
    """Settings for a process that serves hands and does little else.

    Threads hand the interpreter over after 0.05 ms instead of 5 (1 ms with more hands than one),
    and the objects of start-up are left out of garbage collection.
    """
    shorten_pauses(_SWITCH_INTERVAL if hands == 1 else _SWITCH_INTERVAL_SHARED)
