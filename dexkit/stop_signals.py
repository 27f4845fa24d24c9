"""Turn Ctrl-C, SIGTERM and SIGHUP into a request to stop.

A program that dies at once leaves a hand driven by its last command. The death of a thread
requests a stop, too: its work is no longer done.
"""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from dexkit import threads

__all__ = ["StopRequest", "stop_on_signals"]


class StopRequest:
    """Set when the user or the system asks the program to stop.

    :ivar signum: the first signal received, or 0.
    """

    def __init__(self) -> None:
        self.event = threading.Event()
        self.signum = 0

    def __bool__(self) -> bool:
        return self.signum != 0 or self.event.is_set()

    def set(self) -> None:
        """Ask for a stop from the program itself."""
        self.event.set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the request; True when it came."""
        return self.event.wait(timeout)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn SIGINT, SIGTERM, SIGHUP and the death of a thread into a :class:`StopRequest`.

    A second SIGINT interrupts at once. SIGHUP, which comes when the terminal or its ssh connection
    goes, is left alone where it is ignored (``nohup``).
    """
    request = StopRequest()

    def handle(signum: int, frame: FrameType | None) -> None:
        if request and signum == signal.SIGINT:
            raise KeyboardInterrupt
        request.signum = request.signum or signum
        # not here: this may have interrupted event.wait() while that holds the event's lock
        _thread.start_new_thread(request.event.set, ())

    ending = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        ending.append(signal.SIGHUP)
    previous = {s: signal.signal(s, handle) for s in ending}
    try:
        with threads.on_death(lambda worker: request.set()):
            yield request
    finally:
        for signum, handler in previous.items():
            signal.signal(signum, handler)
