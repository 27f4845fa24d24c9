"""An emulated Inspire RH56 on its serial line, or by Modbus on TCP: registers and joints.

:mod:`dexkit.emulators.servo_mechanics` moves the joints, :mod:`dexkit.wire.rh56` has the frames;
a hand with tactile areas feels what its fingers press on as a simulated one does
(:mod:`dexkit.emulators.sim_inspire`).
Implemented registers are those of :class:`~dexkit.wire.rh56.Register`. Others read as 0, and writes
to them are answered without effect; no source says what the device does there.

Forces are those of the mechanics, in thousandths; currents and temperatures are assumed. Not
modelled: how far a fast finger exceeds its limit of force, and storing of settings.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from dexkit.clock import RealClock
from dexkit.emulators.faults import RH56_FAULTS, RH56_TCP_FAULTS, Fault, parse_fault
from dexkit.emulators.modbus_line import tcp_answers
from dexkit.emulators.request_line import RequestLine, ServedDevice
from dexkit.emulators.serial_port import Port
from dexkit.emulators.servo_device import ServoDevice
from dexkit.emulators.servo_mechanics import ServoMechanics
from dexkit.emulators.sim_inspire import FtpMechanics
from dexkit.emulators.tcp_port import TcpPort
from dexkit.errors import WireError
from dexkit.hand import Floats, Side
from dexkit.models import INSPIRE_DFX, INSPIRE_FTP
from dexkit.wire.modbus import Function, TcpParser
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

__all__ = ["Rh56", "Rh56Hand", "Rh56TcpHand", "rh56_bus"]

_CELSIUS = 35  # assumed


class Rh56(ServoDevice):
    """The device: registers and joints.

    :param number: its id on the line.
    :param object_at: percent of closing at which the joints touch an object; None for none.
    :param start: percent of closing at first; None for a relaxed pose.
    :param tactile: an RH56DFTP, with tactile areas.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        side: Side = Side.RIGHT,
        *,
        number: int = 1,
        object_at: float | None = None,
        start: float | None = None,
        tactile: bool = False,
        now: float = 0.0,
    ) -> None:
        self.number = number
        model, mechanics = (INSPIRE_FTP, FtpMechanics) if tactile else (INSPIRE_DFX, ServoMechanics)
        servos = mechanics(model, side, object_at=object_at, start=start, resolution=1 / FULL)
        super().__init__(servos, model.joints[side], FULL, now)
        self.words = {
            Register.FORCE_SET: [FULL] * JOINTS,
            Register.SPEED_SET: [FULL] * JOINTS,
        }
        self.errors = [Error(0)] * JOINTS
        self._felt: tuple[Floats, bytes] | None = None
        self._drive()

    def apply_fault(self, kind: str) -> None:
        """Apply the fault ``locked``."""
        if kind == "locked":
            self.lock()

    def lock(self) -> None:
        """Every joint reports a locked rotor and has no power, until its error is cleared."""
        self.errors = [Error.LOCKED_ROTOR] * JOINTS
        self._drive()

    def handle(self, frame: Frame) -> Frame | None:
        """Answer a frame; None for an invalid frame, or one to another device."""
        if frame.device != self.number or frame.answer:
            return None
        data = bytes([DONE])
        if frame.operation is Operation.READ:
            if len(frame.data) != 1:
                return None
            data = self.read(frame.address, frame.data[0])
        else:
            self.write(frame.address, frame.data)
        return Frame(self.number, frame.operation, frame.address, data, answer=True)

    def write(self, address: int, data: bytes) -> None:
        """Write bytes to consecutive registers from an address."""
        if address == Register.CLEAR_ERROR and data[:1] == b"\x01":
            self.errors = [Error(0)] * JOINTS
            self._drive()
            return
        try:
            values = numbers(data)
        except WireError:
            return
        for at, value in enumerate(values):
            self._write_word(address + 2 * at, value)
        self._drive()

    def _write_word(self, address: int, value: int) -> None:
        joint, odd = divmod(address - Register.ANGLE_SET, 2)
        if not odd and 0 <= joint < JOINTS:
            if value != UNCHANGED:
                self.goals[joint] = min(max(value, 0), FULL)
            return
        for register, words in self.words.items():
            joint, odd = divmod(address - register, 2)
            if not odd and 0 <= joint < JOINTS:
                words[joint] = min(max(value, 0), FULL)

    def read_registers(self, function: Function, address: int, count: int) -> list[int]:
        """Read by Modbus: a register is the two bytes from its address on."""
        del function  # no source distinguishes them
        return list(np.frombuffer(self.read(address, 2 * count), "<u2").tolist())

    def write_registers(self, address: int, values: tuple[int, ...]) -> None:
        """Write by Modbus."""
        self.write(address, np.array(values, "<u2").tobytes())

    def _drive(self) -> None:
        """Apply goals and speeds."""
        driven = [g is not None and not e for g, e in zip(self.goals, self.errors, strict=True)]
        self.drive(self.words[Register.SPEED_SET], driven)

    def read(self, address: int, count: int) -> bytes:
        """Read ``count`` bytes of registers from an address."""
        state = self.mechanics.state(self.now)
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
        if isinstance(self.mechanics, FtpMechanics):
            places[Register.TOUCH] = self._touch(self.mechanics)
        found = bytearray(count)
        for at, data in places.items():
            begin, end = max(address, at), min(address + count, at + len(data))
            if begin < end:
                found[begin - address : end - address] = data[begin - at : end - at]
        return bytes(found)

    def _touch(self, hand: FtpMechanics) -> bytes:
        pressure = hand.pressure
        if self._felt is None or self._felt[0] is not pressure:
            counts = np.rint(pressure[np.isfinite(pressure)])  # area after area
            self._felt = pressure, counts.astype("<i2").tobytes()
        return self._felt[1]

    def _status(self, goal: int | None, angle: int, dq: float, error: Error) -> Status:
        if error:
            return Status.LOCKED_ROTOR
        if dq:
            return Status.OPENING if dq > 0 else Status.CLOSING
        return Status.ARRIVED if self.arrived(goal, angle) else Status.FORCE_REACHED


def rh56_bus(
    device: Rh56,
    *,
    baudrate: int = BAUD_RATE,
    answer_time: float = 0.0,
    line_time: bool = True,
    latency_timer: float = 0.0,
    faults: Sequence[Fault] = (),
    start: float = 0.0,
    seed: int = 0,
) -> RequestLine[Frame]:
    """A device on its serial line.

    :param answer_time: seconds from a request to its answer; not known.

    Other parameters as :class:`~dexkit.emulators.serial_line.SerialLine`.
    """

    def answer(frame: Frame) -> bytes | None:
        found = device.handle(frame)
        return None if found is None else found.pack()

    return RequestLine(
        device,
        FrameParser(answers=False),
        answer,
        baudrate=baudrate,
        answer_time=answer_time,
        line_time=line_time,
        latency_timer=latency_timer,
        faults=faults,
        start=start,
        seed=seed,
    )


class Rh56Hand(ServedDevice):
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
        bus = rh56_bus(
            self.device,
            baudrate=baudrate,
            answer_time=answer_time,
            line_time=line_time,
            latency_timer=latency_timer,
            faults=[parse_fault(spec, RH56_FAULTS) for spec in faults],
            start=now,
            seed=seed,
        )
        port = Port(bus, link, check_baudrate=check_baudrate)
        super().__init__(port, RH56_FAULTS, f"{side} id={number} baudrate={baudrate}")


class Rh56TcpHand(ServedDevice):
    """The device on a TCP port of this machine (Modbus), served in a thread.

    :param port: 0 for a free one.
    :param tactile: an RH56DFTP, with tactile areas.
    :param faults: specifications, see :mod:`dexkit.emulators.faults`.
    :raises EmulatorError: the port cannot be had.
    :raises UsageError: a fault or a figure that cannot be.
    """

    def __init__(
        self,
        side: Side = Side.RIGHT,
        *,
        port: int = 0,
        object_pct: float | None = None,
        start_pct: float | None = None,
        tactile: bool = False,
        answer_time: float = 0.0,
        faults: Sequence[str] = (),
        seed: int = 0,
    ) -> None:
        now = RealClock().now()
        self.device = Rh56(side, object_at=object_pct, start=start_pct, tactile=tactile, now=now)
        bus = RequestLine(
            self.device,
            TcpParser(),
            tcp_answers(self.device),
            baudrate=0,
            answer_time=answer_time,
            line_time=False,
            faults=[parse_fault(spec, RH56_TCP_FAULTS) for spec in faults],
            start=now,
            seed=seed,
        )
        super().__init__(
            TcpPort(bus, port), RH56_TCP_FAULTS, f"{side} modbus-tcp{tactile * ' tactile'}"
        )
