"""Send requests and wait for answers, for drivers of request/response devices."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from dexkit.command_age import WriteDeadline
from dexkit.descriptors import wait_readable
from dexkit.drivers.channel import Channel
from dexkit.drivers.serial_port import port_errors
from dexkit.errors import HandLost, HandTimeout

__all__ = ["LATE", "RequestLine", "RequestStatistics"]

LATE = 0.01  # s to wait for a late answer before the next request
_MOST_CHUNKS = 64  # read at most before a request, of a device that sends without end

FrameT = TypeVar("FrameT")
FoundT = TypeVar("FoundT")


FoundFrameT = TypeVar("FoundFrameT", covariant=True)


class Parser(Protocol[FoundFrameT]):
    """Finds answers in a stream of bytes."""

    skipped: int
    damaged: int

    def reset(self) -> None: ...

    def feed(self, data: bytes) -> Iterable[FoundFrameT]: ...


@dataclass
class RequestStatistics:
    """Counters since the object was created.

    :ivar exchanges: requests with an answer; ``timeouts`` without.
    :ivar damaged: answers that could not be read.
    :ivar stray: bytes that belonged to no answer, or came when none was expected; answers to
        another request count as one.
    """

    exchanges: int = 0
    timeouts: int = 0
    damaged: int = 0
    stray: int = 0


class RequestLine:
    """Runs requests one at a time.

    :param statistics: is counted in.
    :param timeout: seconds to wait for an answer.
    """

    def __init__(self, statistics: RequestStatistics, timeout: float) -> None:
        self.statistics = statistics
        self.timeout = timeout
        self._late = True

    def restart(self) -> None:
        """Start over on a new channel, on which old answers may still arrive."""
        self._late = True

    def ask(
        self,
        channel: Channel,
        request: bytes,
        parser: Parser[FrameT],
        match: Callable[[FrameT], FoundT | None],
        before: WriteDeadline | None = None,
    ) -> FoundT:
        """Send a request and return its answer.

        :param match: what an answer holds; None for one that answers something else.
        :param before: deadline for writing the request.
        :raises HandTimeout: no answer in time, or the deadline for writing has passed.
        :raises HandLost: the channel has gone away, or may still deliver the request later.
        """
        with port_errors(channel.place):
            return self._ask(channel, request, parser, match, before)

    def _ask(
        self,
        channel: Channel,
        request: bytes,
        parser: Parser[FrameT],
        match: Callable[[FrameT], FoundT | None],
        before: WriteDeadline | None,
    ) -> FoundT:
        place, descriptor, read = channel.place, channel.fileno(), channel.read
        statistics = self.statistics
        if self._late:  # an answer that comes late would be taken for this one's
            self._late = bool(wait_readable([descriptor], LATE))
        for _ in range(_MOST_CHUNKS):
            if not (data := read()):
                break
            statistics.stray += len(data)
        parser.reset()
        if before is not None:
            before.check()
        if channel.write(request) != len(request):
            raise HandLost(f"{place} takes no more bytes")
        ends = time.monotonic() + self.timeout
        skipped, damaged = parser.skipped, parser.damaged
        try:
            while wait_readable([descriptor], max(0.0, ends - time.monotonic())):
                if not (data := read()):
                    raise HandLost(f"{place} has gone away: no data")
                for frame in parser.feed(data):
                    found = match(frame)
                    if found is not None:
                        statistics.exchanges += 1
                        return found
                    statistics.stray += 1
        finally:
            statistics.stray += parser.skipped - skipped
            statistics.damaged += parser.damaged - damaged
        statistics.timeouts += 1
        self._late = True
        if channel.unsent:
            raise HandLost(
                f"{place} does not accept data; the connection is closed, so that no old goal "
                "arrives later",
                hint="check the network and the hand's supply",
            )
        raise HandTimeout(
            f"the hand on {place} does not answer",
            hint="check its supply, the cable and the id",
        )
