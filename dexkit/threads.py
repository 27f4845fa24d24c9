"""Threads that end the program when they die.

A thread of Python that dies of an exception leaves the rest of the program running: a recorder
that records nothing, a service whose state stands still. There is one rule for every thread of
dexkit: **one that dies ends the program, with a message and an error exit code.**

:class:`Worker` is that rule. When its function raises, it logs why, keeps the exception as
:attr:`Worker.failure`, calls its owner (``failed``), and calls all listeners of
:func:`on_death`. :func:`~dexkit.stop_signals.stop_on_signals` asks: its request is set, so that the
program ends in good order, as on Ctrl-C: hands brake, recordings are finished. Last of all the
command line calls :func:`check` and exits with 1.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator

from dexkit.errors import DexkitError

__all__ = ["Worker", "check", "forget", "on_death"]

_log = logging.getLogger(__name__)

_lock = threading.Lock()
_listeners: list[Callable[[Worker], object]] = []
_dead: list[Worker] = []
_KEPT = 16  # dead workers that are remembered


class Worker(threading.Thread):
    """A thread that runs ``target(*args)`` once; it does not keep the process from ending.

    :param name: what it does, for messages: ``"the NAME thread died"``.
    :param failed: called in the thread with the exception that ended it, before all listeners.

    :ivar failure: what ended it, or None.
    """

    def __init__(
        self,
        name: str,
        target: Callable[..., object],
        *args: object,
        failed: Callable[[Exception], object] | None = None,
    ) -> None:
        super().__init__(name=f"dexkit-{name}", daemon=True)
        self.what = name
        self.failure: Exception | None = None
        self._work = target
        self._arguments = args
        self._failed = failed

    def run(self) -> None:
        """Run the target; called by the thread only."""
        try:
            self._work(*self._arguments)
        except Exception as error:
            self.failure = error
            self._notify(error)

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end. One that could not be started has none to wait for: an owner that
        cleans up must not hide the error that says so.
        """
        if self.ident is not None:
            super().join(timeout)

    def _notify(self, error: Exception) -> None:
        with _lock:
            del _dead[:-_KEPT]
            _dead.append(self)
            listeners = list(_listeners)
        if isinstance(error, DexkitError | OSError | MemoryError):  # foreseen: a full disk, ...
            _log.error("the %s thread ended: %s", self.what, error)
        else:
            _log.error("the %s thread died", self.what, exc_info=error)
        owner: list[Callable[[], object]] = []
        if self._failed is not None:
            failed = self._failed
            owner = [lambda: failed(error)]
        for notify in [
            *owner,
            *((lambda listener=listener: listener(self)) for listener in listeners),
        ]:
            try:
                notify()
            except Exception:
                _log.exception("a listener failed for a thread that died")

    def check(self) -> None:
        """Raise if it has died.

        :raises DexkitError: with what ended it; a DexkitError is raised as it is.
        """
        if self.failure is None:
            return
        if isinstance(self.failure, DexkitError):
            raise self.failure
        raise DexkitError(
            f"the {self.what} thread died: {type(self.failure).__name__}: {self.failure}",
            hint="unless the disk is full or the like, this is a bug in dexkit: please report it",
        ) from self.failure


@contextlib.contextmanager
def on_death(listener: Callable[[Worker], object]) -> Iterator[None]:
    """Call ``listener`` with every worker that dies meanwhile, in its thread."""
    with _lock:
        _listeners.append(listener)
    try:
        yield
    finally:
        with _lock:
            _listeners.remove(listener)


def check() -> None:
    """Raise if a worker of this process has died since :func:`forget`.

    :raises DexkitError: with what ended the first.
    """
    with _lock:
        first = _dead[0] if _dead else None
    if first is not None:
        first.check()


def forget() -> None:
    """Reset :func:`check`: workers that died before are no longer reported."""
    with _lock:
        _dead.clear()
