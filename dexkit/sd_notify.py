"""Tell systemd that a service is up, that it is alive, and that it stops (sd_notify).

The protocol is one datagram of ``KEY=VALUE`` lines to the socket that $NOTIFY_SOCKET names. Where
systemd did not start the program nothing is sent.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable

__all__ = ["notify", "watchdog"]


def notify(*lines: str) -> bool:
    """Send some lines, e.g. ``READY=1``; returns whether they were sent. Never blocks."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if path[:1] not in ("/", "@"):
        return False
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.setblocking(False)
        # "@" stands for the zero byte of a name that is in no file system
        sock.connect("\0" + path[1:] if path[0] == "@" else path)
        sock.send("\n".join(lines).encode())
        return True
    return False


def watchdog(now: Callable[[], float]) -> Callable[[int], None] | None:
    """A function for a loop to call in each turn, which tells systemd that the loop runs.

    It sends three times in the interval that systemd allows (``WatchdogSec=``).

    :param now: seconds of a monotonic clock.
    :returns: None where systemd watches nobody, or another process.
    """
    try:
        allowed = int(os.environ.get("WATCHDOG_USEC", "0")) * 1e-6
        watched = int(os.environ.get("WATCHDOG_PID") or os.getpid())
    except ValueError:
        return None
    if allowed <= 0 or watched != os.getpid():
        return None
    due = now()

    def alive(missed: int = 0) -> None:
        nonlocal due
        if now() >= due:
            due = now() + allowed / 3
            notify("WATCHDOG=1")

    return alive
