"""Find where the clock of a recorder was set back.

A recorder writes the messages of a channel as they come. Where one has an earlier time than the one
before it, the clock was set: from there on, the recording has a stretch of time a second time.
Sorted by time, the two stretches would be mixed, message by message.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import SessionError

__all__ = [
    "LIMIT_NS",
    "ClockStep",
    "Order",
    "drops_in",
    "order_of",
    "refuse_clock_steps",
    "steps_between",
]

LIMIT_NS = 50_000_000
"""A step back is longer than this; what threads of a recorder write late is not."""


@dataclass(frozen=True)
class ClockStep:
    """A step back in the times of a channel.

    :param before_ns: log time of the message before it in the file.
    :param after_ns: of the one after it, which is earlier.
    """

    channel_id: int
    before_ns: int
    after_ns: int

    @property
    def seconds(self) -> float:
        """By how much."""
        return (self.before_ns - self.after_ns) / 1e9

    def __str__(self) -> str:
        when = datetime.fromtimestamp(self.before_ns / 1e9, timezone.utc)
        return f"its clock steps back by {self.seconds:.3f} s at {when:%Y-%m-%d %H:%M:%S.%f} UTC"


@dataclass(frozen=True)
class Order:
    """The log times of a channel in a part of the file, as they follow each other there.

    :param drops: before and after each step back within it.
    """

    first_ns: int
    last_ns: int
    drops: tuple[tuple[int, int], ...] = ()


def drops_in(times: NDArray[np.uint64]) -> NDArray[np.intp]:
    """The places after which the times step back."""
    before, after = times[:-1], times[1:]
    return np.flatnonzero((after < before) & (before - after > LIMIT_NS))


def order_of(times: NDArray[np.uint64]) -> Order:
    """The order of the times of a channel; at least one."""
    found = tuple((int(times[i]), int(times[i + 1])) for i in drops_in(times).tolist())
    return Order(int(times[0]), int(times[-1]), found)


def steps_between(parts: Iterable[Mapping[int, Order]]) -> Iterator[ClockStep]:
    """The steps of every channel.

    :param parts: of the file, as they follow each other; each by the number of the channel.
    """
    last: dict[int, int] = {}
    for part in parts:
        for channel_id, order in part.items():
            before = last.get(channel_id, order.first_ns)
            if order.first_ns + LIMIT_NS < before:
                yield ClockStep(channel_id, before, order.first_ns)
            for a, b in order.drops:
                yield ClockStep(channel_id, a, b)
            last[channel_id] = order.last_ns


def refuse_clock_steps(name: object, steps: Iterable[ClockStep]) -> None:
    """Refuse to put the messages of a recording in order of time, if they lie in stretches that
    overlap.

    :raises SessionError: they do.
    """
    step = max(steps, key=lambda s: s.seconds, default=None)
    if step is not None:
        raise SessionError(
            f"{name}: {step}, so it has a stretch of time twice; in order of time, both would be "
            "mixed",
            hint="take the stretches apart: 'dexkit cut --stretch 1', 2, ...",
        )
