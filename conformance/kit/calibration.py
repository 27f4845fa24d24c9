"""Measure the kit against itself: a loopback subject of known behaviour, on the run's DDS.

A writer of the kit's own sends messages at known instants, and a reader in another participant of
the kit takes them as the recorder takes states: by polling, in a thread of its own. How much
later than written they are stamped is what the kit adds to any time of reception.

The topic belongs to no hand and no robot, so nothing reacts to the messages.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from dexkit.clock import RealClock
from dexkit.conformance.kit.stimulus_record import CALIBRATION_TOPIC, Calibration
from dexkit.dds import DdsNode, Qos, Sample
from dexkit.errors import DdsError
from dexkit.messages import message_type
from dexkit.threads import Worker

__all__ = ["COUNT", "POLL", "Loopback"]

TYPE = "unitree_go::msg::dds_::MotorStates_"
COUNT = 200
PERIOD = 0.003
"""Seconds from message to message: 0.6 s for all of them."""
POLL = 0.001
"""Seconds between two looks for samples, of the calibration's reader and of the recording's.

Woken by each sample, at 2,000 states and 2,500 commands a second, the kit's process spent its time
on waking up, and stamped samples 0.25 s late."""
_MATCH_S = 2.0
_LAST_S = 0.2
"""Seconds that the last messages are waited for."""


class Loopback:
    """Calibrates in its own threads during other waits; a context manager.

    :param receiver: the node that the run is recorded with.
    :param count: messages.
    """

    def __init__(
        self, receiver: DdsNode, *, domain: int, interface: str, count: int = COUNT
    ) -> None:
        self._receiver, self._domain, self._interface = receiver, domain, interface
        self._count = count
        self._stop = threading.Event()
        self._delays: list[int] = []
        self._late: list[int] = []
        self._clock_ns = 0
        self._thread = Worker("calibration", self._run)

    def __enter__(self) -> Loopback:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def result(self) -> Calibration:
        """The result, once all messages were sent."""
        self._thread.join()
        return Calibration(
            sent=len(self._late),
            delay_us=sorted(ns // 1000 for ns in self._delays),
            late_us=sorted(ns // 1000 for ns in self._late),
            clock_us=self._clock_ns // 1000,
        )

    def _run(self) -> None:
        kind = message_type(TYPE)
        try:
            with DdsNode(domain=self._domain, interface=self._interface) as node:
                reader = self._receiver.reader(
                    CALIBRATION_TOPIC,
                    kind,
                    qos=Qos.reader_default(),
                    most=self._count,
                    polled=True,
                )
                try:
                    writer = node.writer(CALIBRATION_TOPIC, kind, qos=Qos.writer_default())
                    if not writer.wait_matched(_MATCH_S):
                        return
                    receiver = Worker("calibration reader", self._receive, reader.take)
                    receiver.start()
                    self._send(writer.write_raw, kind.encode(kind.cls()))
                    receiver.join()
                finally:
                    reader.close()
        except DdsError:  # the run itself meets it, and reports it
            return

    def _send(self, write: Callable[[bytes, int], object], payload: bytes) -> None:
        """Write all messages, each at its time; measure by how much that was missed."""
        clock = RealClock()
        begin = clock.now()
        wall = time.time_ns() - round(begin * 1e9)
        for i in range(1, self._count + 1):
            if self._stop.is_set():
                break
            due = begin + i * PERIOD
            clock.sleep_until(due)
            late = clock.now() - due
            write(payload, time.time_ns())
            self._late.append(max(0, round(late * 1e9)))
        self._clock_ns = abs(time.time_ns() - round(clock.now() * 1e9) - wall)
        self._stop.set()

    def _receive(self, take: Callable[[], list[Sample]]) -> None:
        """Take messages as they come, until all of them are there or no more can be."""
        end = float("inf")
        while len(self._delays) < self._count and time.monotonic() < end:
            time.sleep(POLL)
            for sample in take():
                self._delays.append(max(0, sample.reception_ns - sample.source_timestamp_ns))
            if self._stop.is_set():
                if len(self._delays) >= len(self._late):
                    return
                end = min(end, time.monotonic() + _LAST_S)
