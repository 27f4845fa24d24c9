"""Simulate a serial line and its USB-serial adapter between devices and host, without I/O.

A byte takes its ten bits at the baud rate, both ways, and what the devices send goes through a
USB-serial adapter, which is modelled as an FTDI chip (docs/sources/mx64-ezgripper.md#c2): bytes are
handed to the host at the ticks of a free-running timer, or as soon as 62 of them are there. Faults
may alter an answer on its way.

Not modelled: USB scheduling beyond that, and collisions when a host sends while a device answers.
"""

from __future__ import annotations

import heapq
import logging
import math
import random
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from dexkit.emulators.faults import Fault, FaultSchedule
from dexkit.errors import UsageError

__all__ = ["BITS_PER_BYTE", "LineCounters", "SerialLine"]

log = logging.getLogger("dexkit.emulators")

BITS_PER_BYTE = 10.0
"""8N1: start bit, eight data bits, stop bit."""
_USB_PACKET = 62  # data bytes of a full-speed FTDI packet


@dataclass
class LineCounters:
    """Counters of the line."""

    bytes_in: int = 0
    bytes_out: int = 0
    garbled: int = 0  # bytes at a baud rate that no device has
    dropped: int = 0
    corrupted: int = 0
    delayed: int = 0
    failures: int = 0  # messages on which a device failed inside

    def summary(self) -> str:
        """The counters that are not zero, as one line."""
        return ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in vars(self).items() if v)


class SerialLine(ABC):
    """Timing, faults and host connection of a serial line; a subclass adds the devices.

    :param line_time: simulate byte times and latency; otherwise everything arrives at once.
    :param latency_timer: seconds; 0 for an adapter without one.
    :param faults: to come, times counted from ``start``.
    :param start: time on the caller's clock.
    :param seed: of the faults' random numbers.
    :raises UsageError: the latency timer is negative.

    :ivar host_baudrate: bits a second that the host has set, or None if that is not known;
        devices at another rate receive nothing.
    :ivar unplugged: the adapter is unplugged.
    :ivar failure: the first exception inside a device, a mistake in the emulator, if any.
    """

    counters: LineCounters

    def __init__(
        self,
        *,
        line_time: bool,
        latency_timer: float,
        faults: Sequence[Fault],
        start: float,
        seed: int,
    ) -> None:
        if latency_timer < 0:
            raise UsageError("a latency timer cannot be negative")
        self.line_time = line_time
        self.latency_timer = latency_timer
        self.host_baudrate: int | None = None
        self.unplugged = False
        self.failure: Exception | None = None
        self.schedule = FaultSchedule(faults, start=start)
        self._random = random.Random(seed)
        self._start = start
        self._line_free = start
        self._out: list[tuple[float, int, bytes]] = []
        self._sequence = 0

    # --- the devices

    @abstractmethod
    def advance_to(self, now: float) -> None:
        """Apply due faults and advance the devices to ``now``."""

    @property
    @abstractmethod
    def busy(self) -> bool:
        """Whether a device moves or holds, so that :meth:`advance_to` should be called often."""

    @abstractmethod
    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that the host's adapter began to send at ``now``.

        Call it in order of time, after :meth:`advance_to` of the same ``now``.
        """

    @property
    def broken(self) -> bool:
        """Whether the byte stream is out of step for good, so that the connection must be
        closed.
        """
        return False

    def disconnected(self) -> None:
        """The client has disconnected; bytes on their way to it are lost."""
        self._out.clear()

    # --- to the host

    @property
    def next_time(self) -> float | None:
        """Time of the next byte that is due or the next fault, or None."""
        times = [self._out[0][0]] if self._out else []
        fault = self.schedule.next_time
        if fault is not None:
            times.append(fault)
        return min(times, default=None)

    def behind(self, now: float) -> float:
        """Seconds that the line still needs for the bytes already sent."""
        return max(0.0, self._line_free - now) if self.line_time else 0.0

    def due(self, now: float) -> bytes:
        """The bytes that have reached the host by ``now``."""
        out = b""
        while self._out and self._out[0][0] <= now:
            out += heapq.heappop(self._out)[2]
        self.counters.bytes_out += len(out)
        return out

    def _apply_plug(self) -> None:
        """Handle the begin or end of an ``unplug``; bytes on their way are lost."""
        self.unplugged = bool(self.schedule.active_of("unplug"))
        self._out.clear()

    def _record_failure(self, error: Exception, message: object) -> None:
        """Log that a device raised an exception on ``message``, and continue without an answer."""
        self.counters.failures += 1
        if self.failure is None:
            self.failure = error
            log.error("the emulated device failed on %r (logged once)", message, exc_info=error)

    def _send(self, begin: float, data: bytes, rate: int) -> None:
        """Send ``data`` from a device, its first bit at ``begin``; a fault may alter it."""
        chance = self._random.random
        end = begin + len(data) * BITS_PER_BYTE / rate if self.line_time else begin
        self._line_free = max(self._line_free, end)
        if any(chance() < fault["p"] for fault in self.schedule.active_of("drop")):
            self.counters.dropped += 1
            return
        if any(chance() < fault["p"] for fault in self.schedule.active_of("corrupt")):
            self.counters.corrupted += 1
            bit = self._random.randrange(8 * len(data))
            spoilt = bytearray(data)
            spoilt[bit // 8] ^= 1 << bit % 8
            data = bytes(spoilt)
        late = sum(f["ms"] * 1e-3 for f in self.schedule.active_of("delay") if chance() < f["p"])
        if late:
            self.counters.delayed += 1
        if not self.line_time:
            self._deliver(begin + late, data)
            return
        self._through_adapter(begin + late, data, BITS_PER_BYTE / rate)

    def _through_adapter(self, begin: float, data: bytes, byte_time: float) -> None:
        timer = self.latency_timer
        if timer <= 0:
            self._deliver(begin + len(data) * byte_time, data)
            return
        done = 0
        while done < len(data):
            first = begin + (done + 1) * byte_time
            tick = self._start + math.ceil((first - self._start) / timer) * timer
            there = min(len(data), int((tick - begin) / byte_time + 1e-9)) - done
            if there >= _USB_PACKET:
                there = _USB_PACKET
                tick = begin + (done + there) * byte_time
            there = max(1, there)
            self._deliver(tick, data[done : done + there])
            done += there

    def _deliver(self, at: float, data: bytes) -> None:
        self._sequence += 1
        heapq.heappush(self._out, (at, self._sequence, data))
