"""A service on a hand without DDS, and waiting without a tight clock."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Any

from dexkit.dds import Sample
from dexkit.messages import message_type

__all__ = ["LocalNode", "WaitTimeout", "open_files", "until"]

PATIENCE = 60.0
"""Seconds that something may take which takes one on an idle machine."""


class WaitTimeout(Exception):
    """A condition was not true in time."""


def until(condition: Callable[[], Any], what: str, timeout: float = PATIENCE) -> Any:
    """Poll ``condition`` until it is true; its value.

    :raises WaitTimeout: it was not within ``timeout`` seconds.
    """
    end = time.monotonic() + timeout
    while True:
        found = condition()
        if found:
            return found
        if time.monotonic() > end:
            raise WaitTimeout(f"waited {timeout:g} s for {what}")
        time.sleep(0.01)


def open_files() -> int:
    """Open file descriptors of this process."""
    return len(os.listdir("/proc/self/fd"))


class _Reader:
    def __init__(self, node: LocalNode, kind: str) -> None:
        self._node = node
        self.type = message_type(kind)
        self.pending: list[Sample] = []

    def take(self) -> list[Sample]:
        found, self.pending = self.pending, []
        return found

    def close(self) -> None:
        self._node.readers.pop(id(self), None)


class _Writer:
    def __init__(self, node: LocalNode, topic: str) -> None:
        self._node, self._topic = node, topic

    @property
    def matched(self) -> int:
        return 1

    def write_raw(self, data: bytes, source_timestamp_ns: int | None = None) -> bool:
        self._node.states[self._topic] = (self._node.states.get(self._topic, (0, b""))[0] + 1, data)
        return True

    def close(self) -> None:
        return None


class LocalNode:
    """The part of DDS that a service needs, within one process.

    :ivar states: by topic how many were published, and the newest.
    """

    def __init__(self) -> None:
        self.states: dict[str, tuple[int, bytes]] = {}
        self.readers: dict[int, tuple[str, _Reader, Callable[[], object] | None]] = {}
        self._lock = threading.Lock()

    def writer(self, topic: str, type_name: str, **more: object) -> Any:
        """A writer that keeps the newest message; what is only for other processes is ignored."""
        return _Writer(self, topic)

    def reader(
        self,
        topic: str,
        type_name: str,
        *,
        on_data: Callable[[], object] | None = None,
        **more: object,
    ) -> Any:
        """A reader that :meth:`send` fills."""
        reader = _Reader(self, type_name)
        self.readers[id(reader)] = (topic, reader, on_data)
        return reader

    def endpoints(self) -> list[Any]:
        """No other endpoints."""
        return []

    def close(self) -> None:
        """Nothing to close."""

    def send(self, topic: str, data: bytes) -> None:
        """Have a message arrive, written now."""
        now = time.time_ns()
        for place, reader, wake in list(self.readers.values()):
            if place == topic:
                reader.pending.append(Sample(data, now, now, 1, reader.type))
                if wake is not None:
                    wake()
