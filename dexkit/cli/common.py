"""What the sub-commands share: options, and stopping on Ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

__all__ = ["StopRequest", "dds_options", "stop_on_signals"]


class StopRequest:
    """Set when the user or the system asks the program to stop.

    :ivar signum: the first signal received, or 0.
    """

    def __init__(self) -> None:
        self.event = threading.Event()
        self.signum = 0

    def __bool__(self) -> bool:
        return self.event.is_set()

    def set(self) -> None:
        """Ask for a stop from the program itself."""
        self.event.set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the request; True when it came."""
        return self.event.wait(timeout)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn SIGINT, SIGTERM and SIGHUP into a :class:`StopRequest`.

    A second SIGINT interrupts at once. SIGHUP, which comes when the terminal or its ssh connection
    goes, is left alone where it is ignored (``nohup``).
    """
    request = StopRequest()

    def handle(signum: int, frame: FrameType | None) -> None:
        if request.event.is_set() and signum == signal.SIGINT:
            raise KeyboardInterrupt
        request.signum = request.signum or signum
        request.event.set()

    ending = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        ending.append(signal.SIGHUP)
    previous = {s: signal.signal(s, handle) for s in ending}
    try:
        yield request
    finally:
        for signum, handler in previous.items():
            signal.signal(signum, handler)


def dds_options(*, default_domain: int | None) -> Callable[[F], F]:
    """``--domain`` and ``--interface``; the interface defaults to loopback."""

    def decorate(function: F) -> F:
        function = click.option(
            "--interface",
            default="lo",
            show_default=True,
            metavar="IF",
            help="Network interface. Traffic stays on this machine unless one is named.",
        )(function)
        domain_help = "DDS domain: 0 is the robot, 1 xr_teleoperate's simulation."
        return click.option(
            "--domain",
            type=click.IntRange(0, 230),
            default=default_domain,
            show_default=default_domain is not None,
            help=domain_help,
        )(function)

    return decorate
