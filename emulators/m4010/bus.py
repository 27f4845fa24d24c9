"""The motors on one line behind a USB-serial adapter, sans-IO.

``receive`` takes the bytes that the host sent and when; ``due`` gives the bytes that have reached
the host by a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dexkit.emulators.faults import Fault
from dexkit.emulators.m4010.motor import Motor
from dexkit.emulators.serial_line import BITS_PER_BYTE, LineCounters, SerialLine
from dexkit.errors import UsageError
from dexkit.wire.m4010 import BROADCAST_ID, COMMAND, FrameParser, MotorCmd

__all__ = ["Bus", "Counters"]


@dataclass
class Counters(LineCounters):
    """Counters of the line."""

    commands: int = 0
    answers: int = 0
    broadcasts: int = 0
    unknown_ids: int = 0
    crc_errors: int = 0
    skipped: int = 0
    spoilt: int = 0  # answers cut short, paused, or with stray bytes


class Bus(SerialLine):
    """The line, its motors and its faults.

    :param motors: on the line; ids must differ.
    :param latency_timer: seconds; the product's adapter (CH343) is not known to have one.
    :raises UsageError: two motors have one id, or there is no motor.

    Other parameters as :class:`~dexkit.emulators.serial_line.SerialLine`.
    """

    def __init__(
        self,
        motors: Sequence[Motor],
        *,
        line_time: bool = True,
        latency_timer: float = 0.0,
        faults: Sequence[Fault] = (),
        start: float = 0.0,
        seed: int = 0,
    ) -> None:
        ids = [motor.number for motor in motors]
        if not motors or len(set(ids)) != len(ids):
            raise UsageError(f"a line needs motors with different ids, not {ids}")
        super().__init__(
            line_time=line_time,
            latency_timer=latency_timer,
            faults=faults,
            start=start,
            seed=seed,
        )
        self.motors = list(motors)
        self.counters: Counters = Counters()
        self._parser = FrameParser((COMMAND,))
        self._byte_gap = min(motor.firmware.byte_gap for motor in motors)
        self._last_byte = start

    # --- time and faults

    def advance_to(self, now: float) -> None:
        """Advance faults and motors to ``now``."""
        events = self.schedule.poll(now)
        for motor in self.motors:
            motor.advance_to(now)
        if not events:
            return
        if any(fault.kind == "unplug" for fault, _ in events):
            self._apply_plug()
            self._parser.reset()
        for motor in self.motors:
            motor.apply_faults(self.schedule.active)

    @property
    def busy(self) -> bool:
        """Whether a motor drives or moves, so that :meth:`advance_to` should be called often."""
        return any(not motor.resting for motor in self.motors)

    # --- from the host

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that the host's adapter began to send at ``now``.

        Call it in order of time, after :meth:`advance_to` of the same ``now``.
        """
        counters = self.counters
        counters.bytes_in += len(data)
        rate = self.host_baudrate
        hearing = [m for m in self.motors if rate is None or m.firmware.baudrate == rate]
        if not hearing:
            # at the wrong baud rate they become other bytes, and no frame
            counters.garbled += len(data)
            return
        line_rate = hearing[0].firmware.baudrate
        begin = max(now, self._line_free) if self.line_time else now
        if self._parser.pending and begin - self._last_byte > self._byte_gap:
            self._parser.reset()
        byte_time = BITS_PER_BYTE / line_rate if self.line_time else 0.0
        arrival = begin + len(data) * byte_time
        self._line_free = self._last_byte = arrival
        for frame in self._parser.feed(data):
            assert isinstance(frame, MotorCmd)
            try:
                self._dispatch(frame, hearing, arrival)
            except Exception as error:  # one frame must not end the others' service
                self._record_failure(error, frame)
        counters.crc_errors, counters.skipped = self._parser.crc_errors, self._parser.skipped

    def _dispatch(self, command: MotorCmd, hearing: Sequence[Motor], at: float) -> None:
        counters = self.counters
        counters.commands += 1
        if command.id == BROADCAST_ID:
            counters.broadcasts += 1
        elif all(command.id != motor.number for motor in hearing):
            counters.unknown_ids += 1
        for motor in hearing:
            motor.advance_to(at)
            answer = motor.handle(command)
            if answer is not None:
                counters.answers += 1
                begin = max(at, self._line_free) + motor.firmware.answer_time
                self._answer(begin, answer.pack(), motor.firmware.baudrate)

    def _answer(self, begin: float, data: bytes, rate: int) -> None:
        chance = self._random.random
        before = data
        for fault in self.schedule.active_of("short"):
            if chance() < fault["p"]:
                data = data[: int(fault["bytes"])]
        for fault in self.schedule.active_of("stray"):
            if chance() < fault["p"]:
                noise = self._random.randbytes
                data = noise(int(fault["before"])) + data + noise(int(fault["after"]))
        pauses = [fault for fault in self.schedule.active_of("pause") if chance() < fault["p"]]
        self.counters.spoilt += data != before or bool(pauses)
        for fault in pauses[:1]:
            first = data[: int(fault["bytes"])]
            self._send(begin, first, rate)
            begin += len(first) * BITS_PER_BYTE / rate + fault["ms"] * 1e-3
            data = data[len(first) :]
        if data:
            self._send(begin, data, rate)
