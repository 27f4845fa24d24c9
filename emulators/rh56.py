"""An emulated Inspire RH56DFX on a serial line: registers and joints.

:mod:`dexkit.emulators.servo_mechanics` moves the joints, :mod:`dexkit.wire.rh56` has the frames.
The registers that are there are those of :class:`~dexkit.wire.rh56.Register`; others read as 0, and
writes to them are answered and change nothing. No source says what the device does with them.

Forces are those of the mechanics, in thousandths; currents and temperatures are assumed. Not
modelled: Modbus, the tactile sensors of other models, how far a fast finger exceeds its limit of
force, and storing of settings.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.clock import RealClock
from dexkit.emulators.faults import RH56_FAULTS, Fault, parse_fault
from dexkit.emulators.joint_mechanics import FixedSteps
from dexkit.emulators.serial_line import BITS_PER_BYTE, LineCounters, SerialLine
from dexkit.emulators.serial_port import Port
from dexkit.emulators.servo_mechanics import STEP, ServoMechanics
from dexkit.errors import WireError
from dexkit.hand import HandCommand, JointMode, Side
from dexkit.models import INSPIRE_DFX
from dexkit.wire.rh56 import (
    BAUD_RATE,
    DONE,
    FULL,
    JOINTS,
    UNCHANGED,
    Error,
    Frame,
    FrameParser,
    Operation,
    Register,
    Status,
    numbers,
)

__all__ = ["Rh56", "Rh56Bus", "Rh56Hand"]

_CELSIUS = 35  # assumed
_NEAR = 0.01  # of the travel within which a joint that stands has arrived
_BYTE_GAP = 5e-3  # s after which a frame begun is dropped; assumed
_MODE = int(JointMode.FOC), int(JointMode.BRAKE)


class Rh56:
    """The device: registers and joints.

    :param number: its id on the line.
    :param object_at: percent of closing at which the joints touch an object; None for none.
    :param start: percent of closing at first; None for a relaxed pose.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        side: Side = Side.RIGHT,
        *,
        number: int = 1,
        object_at: float | None = None,
        start: float | None = None,
        now: float = 0.0,
    ) -> None:
        self.number = number
        self.mechanics = ServoMechanics(
            INSPIRE_DFX, side, object_at=object_at, start=start, resolution=1 / FULL
        )
        self._full = np.array([joint.dq_max for joint in INSPIRE_DFX.joints[side]])
        self._steps = FixedSteps(STEP)
        self._steps.restart(now)
        self.goals: list[int | None] = [None] * JOINTS
        """What each joint goes to; None while it stays where it is."""
        self.words = {
            Register.FORCE_SET: [FULL] * JOINTS,
            Register.SPEED_SET: [FULL] * JOINTS,
        }
        self.errors = [Error(0)] * JOINTS
        self._now = now
        self._drive()

    def advance_to(self, now: float) -> None:
        """Let the joints live up to ``now``."""
        self.mechanics.step(self._steps.due(now))
        self._now = now

    @property
    def resting(self) -> bool:
        """Whether no joint moves."""
        return not self.mechanics.state(self._now).dq.any()

    def lock(self) -> None:
        """Every joint reports a locked rotor and has no power, until its error is cleared."""
        self.errors = [Error.LOCKED_ROTOR] * JOINTS
        self._drive()

    def handle(self, frame: Frame) -> Frame | None:
        """The answer to a frame; None to one of another device, or that makes no sense."""
        if frame.device != self.number or frame.answer:
            return None
        data = bytes([DONE])
        if frame.operation is Operation.READ:
            if len(frame.data) != 1:
                return None
            data = self._memory(frame.address, frame.data[0])
        else:
            self._write(frame.address, frame.data)
        return Frame(self.number, frame.operation, frame.address, data, answer=True)

    def _write(self, address: int, data: bytes) -> None:
        if address == Register.CLEAR_ERROR and data[:1] == b"\x01":
            self.errors = [Error(0)] * JOINTS
            self._drive()
            return
        try:
            values = numbers(data)[:JOINTS]
        except WireError:
            return
        if address == Register.ANGLE_SET:
            self.goals[: len(values)] = [
                before if value == UNCHANGED else min(max(value, 0), FULL)
                for value, before in zip(values, self.goals, strict=False)
            ]
        elif address in self.words:
            words = self.words[Register(address)]
            words[: len(values)] = [min(max(value, 0), FULL) for value in values]
        self._drive()

    def _drive(self) -> None:
        """Put goals and speeds in force."""
        driven = [g is not None and not e for g, e in zip(self.goals, self.errors, strict=True)]
        speeds = np.array(self.words[Register.SPEED_SET]) / FULL * self._full
        command = HandCommand.position([(goal or 0) / FULL for goal in self.goals], dq=speeds)
        command.mode[:] = [_MODE[not on] for on in driven]
        self.mechanics.apply(command)

    def _memory(self, address: int, count: int) -> bytes:
        """So many bytes of the registers from an address on."""
        state = self.mechanics.state(self._now)
        angles = np.round(state.q * FULL).astype(int).tolist()
        forces = np.round(np.abs(state.tau_est) * FULL).astype(int).tolist()
        goals = [UNCHANGED if goal is None else goal for goal in self.goals]
        words = {
            Register.ANGLE_SET: goals,
            **self.words,
            Register.ANGLE_ACT: angles,
            Register.FORCE_ACT: forces,
            Register.CURRENT: forces,
        }
        status = [
            self._status(goal, angle, dq, error)
            for goal, angle, dq, error in zip(
                self.goals, angles, state.dq.tolist(), self.errors, strict=True
            )
        ]
        places = {
            Register.ID: bytes([self.number]),
            Register.ERROR: bytes(self.errors),
            Register.STATUS: bytes(status),
            Register.TEMPERATURE: bytes([_CELSIUS] * JOINTS),
            **{at: np.array(values, "<i2").tobytes() for at, values in words.items()},
        }
        found = bytearray(count)
        for at, data in places.items():
            for i, value in enumerate(data, int(at) - address):
                if 0 <= i < count:
                    found[i] = value
        return bytes(found)

    @staticmethod
    def _status(goal: int | None, angle: int, dq: float, error: Error) -> Status:
        if error:
            return Status.LOCKED_ROTOR
        if dq:
            return Status.OPENING if dq > 0 else Status.CLOSING
        arrived = goal is None or abs(goal - angle) <= _NEAR * FULL
        return Status.ARRIVED if arrived else Status.FORCE_REACHED


@dataclass
class Counters(LineCounters):
    """Counters of the line."""

    requests: int = 0
    answers: int = 0
    unknown_ids: int = 0
    damaged: int = 0
    skipped: int = 0


class Rh56Bus(SerialLine):
    """One device on its line.

    :param answer_time: seconds from a request to its answer; not known.

    Other parameters as :class:`~dexkit.emulators.serial_line.SerialLine`.
    """

    def __init__(
        self,
        device: Rh56,
        *,
        baudrate: int = BAUD_RATE,
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
        self.counters: Counters = Counters()
        self._answer_time = answer_time
        self._parser = FrameParser(answers=False)
        self._last_byte = start

    def advance_to(self, now: float) -> None:
        """Let faults strike and the device live up to ``now``."""
        events = self.schedule.poll(now)
        self.device.advance_to(now)
        for fault, begins in events:
            if fault.kind == "unplug":
                self._apply_plug()
                self._parser.reset()
            elif fault.kind == "locked" and begins:
                self.device.lock()

    @property
    def busy(self) -> bool:
        """Whether a joint moves."""
        return not self.device.resting

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that the host's adapter began to send at ``now``."""
        counters, rate = self.counters, self.baudrate
        counters.bytes_in += len(data)
        if self.host_baudrate not in (None, rate):
            counters.garbled += len(data)
            return
        begin = max(now, self._line_free) if self.line_time else now
        if self._parser.pending and begin - self._last_byte > _BYTE_GAP:
            self._parser.reset()
        arrival = begin + (len(data) * BITS_PER_BYTE / rate if self.line_time else 0.0)
        self._line_free = self._last_byte = arrival
        for frame in self._parser.feed(data):
            counters.requests += 1
            counters.unknown_ids += frame.device != self.device.number
            self.device.advance_to(arrival)
            try:
                answer = self.device.handle(frame)
                payload = b"" if answer is None else answer.pack()
            except Exception as error:  # one frame must not end the others' service
                self._record_failure(error, frame)
                continue
            if payload:
                counters.answers += 1
                self._send(max(arrival, self._line_free) + self._answer_time, payload, rate)
        counters.damaged, counters.skipped = self._parser.damaged, self._parser.skipped


class Rh56Hand:
    """The device on a pseudo-terminal, served in a thread.

    :param link: where the terminal's link is put; None for a name in a temporary directory.
    :param faults: specifications, see :mod:`dexkit.emulators.faults`.
    :raises EmulatorError: the link cannot be made.
    :raises UsageError: a fault or a figure that cannot be.
    """

    def __init__(
        self,
        side: Side = Side.RIGHT,
        *,
        link: str | os.PathLike[str] | None = None,
        number: int = 1,
        object_pct: float | None = None,
        start_pct: float | None = None,
        baudrate: int = BAUD_RATE,
        answer_time: float = 0.0,
        line_time: bool = True,
        latency_timer: float = 0.0,
        faults: Sequence[str] = (),
        seed: int = 0,
        check_baudrate: bool = True,
    ) -> None:
        now = RealClock().now()
        self.device = Rh56(side, number=number, object_at=object_pct, start=start_pct, now=now)
        self.bus = Rh56Bus(
            self.device,
            baudrate=baudrate,
            answer_time=answer_time,
            line_time=line_time,
            latency_timer=latency_timer,
            faults=[parse_fault(spec, RH56_FAULTS) for spec in faults],
            start=now,
            seed=seed,
        )
        self.port = Port(self.bus, link, check_baudrate=check_baudrate)
        self.port.start()

    @property
    def path(self) -> str:
        """Path for a client to open."""
        return self.port.path

    def inject(self, spec: str) -> None:
        """Have a fault now (or at its ``@TIME`` from now)."""
        self.port.inject(parse_fault(spec, RH56_FAULTS))

    def close(self) -> None:
        """Stop, and remove the path. May be called twice."""
        self.port.close()

    def __enter__(self) -> Rh56Hand:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
