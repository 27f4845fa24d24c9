"""Data sources of a page: a live domain, or a recording with its marks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from dexkit.watch import Collector, Mark
from dexkit.watch.listener import Listener

__all__ = ["HISTORY", "Live", "Recorded", "Source"]

HISTORY = 60.0
"""Seconds that a paused live page goes back, at most."""


class Source(Protocol):
    """A live domain or a recording that a page shows, beside others."""

    @property
    def title(self) -> str:
        """For people."""
        ...

    @property
    def live(self) -> bool:
        """Whether it goes on by itself."""
        ...

    @property
    def collector(self) -> Collector:
        """What is known of it."""
        ...

    @property
    def marks(self) -> Sequence[Mark]:
        """Moments to go to."""
        ...

    def poll(self) -> float:
        """Bring the collector up to date; returns the end of its time line, seconds."""
        ...


@dataclass(frozen=True)
class Live:
    """A DDS domain."""

    title: str
    listener: Listener
    live: bool = True
    marks: Sequence[Mark] = ()

    @property
    def collector(self) -> Collector:
        """What is known of it."""
        return self.listener.collector

    def poll(self) -> float:
        """Take new samples; returns now."""
        self.listener.poll()
        return max(0.0, self.collector.seconds(time.time_ns()))


@dataclass(frozen=True)
class Recorded:
    """A recording."""

    title: str
    collector: Collector
    marks: Sequence[Mark] = ()
    live: bool = False

    def poll(self) -> float:
        """The end of the recording."""
        return self.collector.last
