"""An emulated BrainCo Revo2 on its serial line (Modbus RTU): registers and joints.

:mod:`dexkit.emulators.servo_mechanics` moves the joints. Implemented registers are those of
:mod:`dexkit.wire.revo2`, in parts of the travel. Any other register is refused (illegal address),
and so is the unit mode of degrees; no source says what the device does there.

The current is the mechanics', in thousandths of the limit. Not modelled: the calibration after
power-on, in which the real hand opens and ignores commands; control by time, current and PWM; turbo
mode, gestures, protection currents, tactile sensors, and storing of settings.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from dexkit.clock import RealClock
from dexkit.emulators.faults import REVO2_FAULTS, parse_fault
from dexkit.emulators.modbus_line import rtu_answers
from dexkit.emulators.request_line import RequestLine, ServedDevice
from dexkit.emulators.serial_port import Port
from dexkit.emulators.servo_device import ServoDevice
from dexkit.emulators.servo_mechanics import ServoMechanics
from dexkit.hand import Side
from dexkit.models import BRAINCO_REVO2
from dexkit.wire.modbus import Exceptional, Function, Refusal, RtuParser
from dexkit.wire.revo2 import (
    BAUD_RATE,
    FULL,
    IDS,
    JOINTS,
    SIDES,
    TEXT,
    UNITS,
    Holding,
    Input,
    MotorStatus,
    UnitMode,
)

__all__ = ["Revo2", "Revo2Hand"]

# observed on a hand, and the letters of a model without tactile sensors
# (docs/sources/unitree-dex.md#j1): BrainCo's library reads both
_FIRMWARE = "1.0.14.U"
_SERIAL_NUMBER = {Side.LEFT: "BCXRL000000DEXKIT", Side.RIGHT: "BCXRR000000DEXKIT"}
_PAIRS = 2 * JOINTS


class Revo2(ServoDevice):
    """The device: registers and joints.

    :param number: its Modbus unit; None for that of its side.
    :param object_at: percent of closing at which the joints touch an object; None for none.
    :param start: percent of closing at first; None for a relaxed pose.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        side: Side = Side.RIGHT,
        *,
        number: int | None = None,
        object_at: float | None = None,
        start: float | None = None,
        now: float = 0.0,
    ) -> None:
        self.side = side
        self.number = UNITS[side] if number is None else number
        joints = BRAINCO_REVO2.joints[side]
        mechanics = ServoMechanics(
            BRAINCO_REVO2, side, object_at=object_at, start=start, resolution=1 / FULL
        )
        super().__init__(mechanics, joints, FULL, now)
        self._limit = np.array([joint.tau_max for joint in joints])
        self.speeds = [FULL] * JOINTS

    def apply_fault(self, kind: str) -> None:
        """Do nothing: the device has no fault kind of its own."""
        raise ValueError(kind)

    def read_registers(self, function: Function, address: int, count: int) -> list[int]:
        """Read ``count`` registers from an address.

        :raises Refusal: one of them does not exist.
        """
        found = self._inputs() if function is Function.READ_INPUT else self._holdings()
        try:
            return [found[at] for at in range(address, address + count)]
        except KeyError:
            raise Refusal(Exceptional.ILLEGAL_ADDRESS) from None

    def write_registers(self, address: int, values: tuple[int, ...]) -> None:
        """Write positions and speeds, the unit mode, or the id.

        :raises Refusal: another register, or an invalid value.
        """
        if address == Holding.POSITION_AND_SPEED and len(values) == _PAIRS:
            if max(values) > FULL:
                raise Refusal(Exceptional.ILLEGAL_VALUE)
            self.goals = list(values[::2])
            self.speeds = [speed or FULL for speed in values[1::2]]
            self.drive(self.speeds, [goal is not None for goal in self.goals])
        elif address == Holding.UNIT_MODE and len(values) == 1:
            if values[0] != UnitMode.NORMALISED:
                raise Refusal(Exceptional.ILLEGAL_VALUE)
        elif address == Holding.ID and len(values) == 1 and values[0] in IDS:
            self.number = values[0]
        else:
            raise Refusal(Exceptional.ILLEGAL_ADDRESS)

    def _holdings(self) -> dict[int, int]:
        now = [round(q * FULL) for q in self.mechanics.q]
        goals = [at if goal is None else goal for at, goal in zip(now, self.goals, strict=True)]
        pairs = [value for pair in zip(goals, self.speeds, strict=True) for value in pair]
        numbers = {side: number for number, side in SIDES.items()}
        return {
            Holding.SIDE: numbers[self.side],
            Holding.UNIT_MODE: UnitMode.NORMALISED,
            Holding.ID: self.number,
            **dict(enumerate(pairs, Holding.POSITION_AND_SPEED)),
        }

    def _inputs(self) -> dict[int, int]:
        state = self.mechanics.state(self.now)
        q = np.round(state.q * FULL).astype(int).tolist()
        dq = np.round(state.dq / self.full_speed * FULL).astype(int).tolist()
        current = np.round(state.tau_est / self._limit * FULL).astype(int).tolist()
        status = [
            MotorStatus.RUNNING
            if speed
            else MotorStatus.IDLE
            if self.arrived(goal, at)
            else MotorStatus.STALLED
            for goal, at, speed in zip(self.goals, q, dq, strict=True)
        ]
        return {
            **dict(enumerate(q, Input.POSITION)),
            **dict(enumerate(dq, Input.SPEED)),
            **dict(enumerate(current, Input.CURRENT)),
            **dict(enumerate(status, Input.STATUS)),
            **_text(Input.FIRMWARE, _FIRMWARE),
            **_text(Input.SERIAL_NUMBER, _SERIAL_NUMBER[self.side]),
        }


def _text(address: int, text: str) -> dict[int, int]:
    words = np.frombuffer(text.encode("ascii").ljust(2 * TEXT, b"\0"), ">u2")
    return dict(enumerate(words.tolist(), address))


class Revo2Hand(ServedDevice):
    """The device on a pseudo-terminal, served in a thread.

    :param link: where the terminal's link is put; None for a name in a temporary directory.
    :param number: Modbus unit; None for that of its side.
    :param faults: specifications, see :mod:`dexkit.emulators.faults`.
    :raises EmulatorError: the link cannot be made.
    :raises UsageError: a fault or a value is invalid.
    """

    def __init__(
        self,
        side: Side = Side.RIGHT,
        *,
        link: str | os.PathLike[str] | None = None,
        number: int | None = None,
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
        device = Revo2(side, number=number, object_at=object_pct, start=start_pct, now=now)
        self.device = device
        bus = RequestLine(
            device,
            RtuParser(answers=False),
            rtu_answers(device, lambda: device.number),
            baudrate=baudrate,
            answer_time=answer_time,
            line_time=line_time,
            latency_timer=latency_timer,
            faults=[parse_fault(spec, REVO2_FAULTS) for spec in faults],
            start=now,
            seed=seed,
        )
        port = Port(bus, link, check_baudrate=check_baudrate)
        description = f"{side} id={device.number} baudrate={baudrate}"
        super().__init__(port, REVO2_FAULTS, description)
