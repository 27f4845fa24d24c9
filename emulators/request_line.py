"""Emulate a single request/response device on its line, and serve it on a port.

Used for every request/response protocol: a parser finds requests in the bytes, a function answers
them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from dexkit.emulators.faults import Fault, FaultFamily, parse_fault
from dexkit.emulators.line_server import LineServer
from dexkit.emulators.serial_line import BITS_PER_BYTE, LineCounters, SerialLine

__all__ = ["RequestCounters", "RequestDevice", "RequestLine", "ServedDevice"]

_BYTE_GAP = 5e-3  # s after which a frame begun is dropped; assumed

FrameT = TypeVar("FrameT")
FoundFrameT = TypeVar("FoundFrameT", covariant=True)
ServedT = TypeVar("ServedT", bound="ServedDevice")


class RequestDevice(Protocol):
    """A device that answers requests, without its serial line."""

    @property
    def resting(self) -> bool:
        """Whether nothing moves."""

    def advance_to(self, now: float) -> None:
        """Advance the device to ``now``."""

    def apply_fault(self, kind: str) -> None:
        """Apply a fault kind specific to this device."""


class Parser(Protocol[FoundFrameT]):
    """Finds requests in a stream of bytes."""

    skipped: int
    damaged: int

    @property
    def pending(self) -> int: ...

    def reset(self) -> None: ...

    def feed(self, data: bytes) -> Iterable[FoundFrameT]: ...


@dataclass
class RequestCounters(LineCounters):
    """Counters of the line."""

    requests: int = 0
    answers: int = 0
    damaged: int = 0
    skipped: int = 0


class RequestLine(SerialLine, Generic[FrameT]):
    """One device on its line.

    :param parser: of requests.
    :param answer: the bytes that answer a request; None where the device is silent.
    :param baudrate: of the device; unused without line time.
    :param answer_time: seconds from a request to its answer.

    Other parameters as :class:`~dexkit.emulators.serial_line.SerialLine`.
    """

    def __init__(
        self,
        device: RequestDevice,
        parser: Parser[FrameT],
        answer: Callable[[FrameT], bytes | None],
        *,
        baudrate: int,
        answer_time: float = 0.0,
        line_time: bool = True,
        latency_timer: float = 0.0,
        faults: Sequence[Fault] = (),
        start: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__(
            line_time=line_time, latency_timer=latency_timer, faults=faults, start=start, seed=seed
        )
        self.device = device
        self.baudrate = baudrate
        self.counters: RequestCounters = RequestCounters()
        self._answer_time = answer_time
        self._parser = parser
        self._answer = answer
        self._last_byte = start

    def advance_to(self, now: float) -> None:
        """Apply due faults and advance the device to ``now``."""
        events = self.schedule.poll(now)
        self.device.advance_to(now)
        for fault, begins in events:
            if fault.kind == "unplug":
                self._apply_plug()
                self._parser.reset()
            elif begins and not fault.lasting:
                self.device.apply_fault(fault.kind)

    @property
    def busy(self) -> bool:
        """Whether the device moves."""
        return not self.device.resting

    @property
    def broken(self) -> bool:
        """Whether the byte stream is out of step for good, so that the connection must be
        closed.
        """
        return getattr(self._parser, "broken", False)

    def disconnected(self) -> None:
        """The client has disconnected."""
        super().disconnected()
        self._parser.reset()

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that the host's adapter began to send at ``now``."""
        counters, rate = self.counters, self.baudrate
        counters.bytes_in += len(data)
        if self.host_baudrate not in (None, rate):
            counters.garbled += len(data)
            return
        begin = max(now, self._line_free) if self.line_time else now
        if self.line_time and self._parser.pending and begin - self._last_byte > _BYTE_GAP:
            self._parser.reset()
        arrival = begin + (len(data) * BITS_PER_BYTE / rate if self.line_time else 0.0)
        self._line_free = self._last_byte = arrival
        for frame in self._parser.feed(data):
            counters.requests += 1
            self.device.advance_to(arrival)
            try:
                payload = self._answer(frame)
            except Exception as error:  # one frame must not end the others' service
                self._record_failure(error, frame)
                continue
            if payload:
                counters.answers += 1
                begin = max(arrival, self._line_free) if self.line_time else arrival
                self._send(begin + self._answer_time, payload, rate)
        counters.damaged, counters.skipped = self._parser.damaged, self._parser.skipped


class ServedDevice:
    """A device on a port that is served in a thread; a context manager.

    :param port: not started yet.
    :param family: fault kinds of the device.
    :param description: text of the ready line after the path.
    """

    def __init__(self, port: LineServer, family: FaultFamily, description: str) -> None:
        self.port = port
        self._family = family
        self._description = description
        port.start()

    @property
    def path(self) -> str:
        """Path or address that a client opens."""
        return self.port.path

    @property
    def error(self) -> BaseException | None:
        """The error that ended its service, or None."""
        return self.port.error

    @property
    def failure(self) -> Exception | None:
        """The first exception on a request, which the service has survived, if any."""
        return self.port.line.failure

    @property
    def ready_lines(self) -> list[str]:
        """Its path and description."""
        return [f"ready: {self.path} {self._description}"]

    def summaries(self) -> list[str]:
        """Its path and counters."""
        text = self.port.line.counters.summary() or "nothing was sent"
        if self.port.overruns:
            text += f", {self.port.overruns} bytes not read by the client"
        return [f"{self.path}: {text}"]

    def inject(self, spec: str) -> None:
        """Inject a fault now (or at its ``@TIME`` from now).

        :raises UsageError: the fault is invalid.
        """
        self.port.inject(parse_fault(spec, self._family))

    def close(self) -> None:
        """Stop, and remove the path. May be called twice."""
        self.port.close()

    def __enter__(self: ServedT) -> ServedT:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
