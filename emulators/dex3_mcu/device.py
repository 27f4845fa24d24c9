"""Emulate the Dex3-1's processor and its seven motors, without I/O: a frame in, a frame out.

The processor decodes a frame, passes each motor its packet, and answers with the present state.
Each motor keeps its last command and runs its own time-out protection: a pulled USB cable does not
stop a motor, its protection does.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.clock import Clock, RealClock
from dexkit.emulators.dex3_mcu.answer import AnswerWriter
from dexkit.emulators.dex3_mcu.command import CommandReader, MotorCommand
from dexkit.emulators.dex3_mcu.settings import Firmware
from dexkit.emulators.dex3_mcu.wiring import Wiring
from dexkit.emulators.dex3_mechanics import Dex3Mechanics
from dexkit.emulators.faults import Fault, FaultSchedule
from dexkit.emulators.finger_mechanics import AMBIENT, STEP
from dexkit.errors import ChecksumError, WireError
from dexkit.hand import JointMode, MotorError, Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import DecodedCommand, HandCodec

__all__ = ["Counters", "Dex3Mcu"]

_MAX_CATCH_UP = 10.0  # seconds; a longer pause of the caller is not simulated
_KNOWN = (int(JointMode.BRAKE), int(JointMode.FOC))
_HOT_SLICE = 0.05  # seconds between settings of the temperature of an ``overheat`` fault


@dataclass
class Counters:
    """Counters of the hand."""

    frames: int = 0
    answers: int = 0
    bad_size: int = 0
    bad_crc: int = 0
    damaged_packets: int = 0  # lost in good frames, and packets for motors that are not there
    ignored_packets: int = 0  # good ones that a motor did not take
    broadcasts: int = 0
    trips: int = 0
    unread: int = 0  # answers that made room for a newer one
    dropped: int = 0
    corrupted: int = 0
    delayed: int = 0

    def summary(self) -> str:
        """One line with the counters that are not zero."""
        return ", ".join(f"{v} {k.replace('_', ' ')}" for k, v in vars(self).items() if v)


class _Motor:
    """Command and time-out protection of one motor."""

    __slots__ = ("deadline", "driven", "silent", "tripped")

    def __init__(self) -> None:
        self.deadline = math.inf  # when the protection trips
        self.tripped = False
        self.silent = False
        self.driven = False


class Dex3Mcu:
    """A Dex3-1 behind its USB endpoints.

    :param mechanics: mechanics of the same side; a new one by default.
    :param clock: real time by default; with a manual clock the hand is deterministic.
    :param wiring: where and how the motors and sensors are mounted; by default as dexkit assumes.
    :param faults: planned faults, times counted from now. Those for the other side are ignored.
    :param seed: seed of the faults' random numbers.

    :ivar plugged: whether the USB cable is plugged. The motors have a supply of their own.
    :ivar late: seconds by which the last answer must be delayed.
    :ivar on_drive: called with the time, a joint, and its command for each command that drives a
        motor; with None for the command, when the motor stops being driven.
    :ivar on_stall: called with ``"in"`` or ``"out"`` when that endpoint must halt.
    """

    def __init__(
        self,
        side: Side,
        *,
        mechanics: Dex3Mechanics | None = None,
        clock: Clock | None = None,
        firmware: Firmware | None = None,
        wiring: Wiring | None = None,
        faults: Sequence[Fault] = (),
        seed: int = 0,
    ) -> None:
        self.side = side
        self.mechanics = mechanics or Dex3Mechanics(side)
        self.firmware = firmware or Firmware()
        self.counters = Counters()
        self.plugged = True
        self.late = 0.0
        self.on_stall: Callable[[str], None] = lambda endpoint: None
        self.on_drive: Callable[[float, int, MotorCommand | None], None] | None = None
        self.wiring = wiring or Wiring.assumed(side)
        self._codec = HandCodec(
            DEX3_1.joints[side], self.wiring.bus_map, mounting=self.wiring.mounting
        )
        self._reader = CommandReader(self.wiring)
        self._writer = AnswerWriter(
            self.mechanics, self.wiring, self.firmware.model_code, self.firmware.no_value
        )
        self._clock: Clock = clock or RealClock()
        self._random = random.Random(seed)
        self._motors = [_Motor() for _ in DEX3_1.joints[side]]
        self._origin = self._now = self._clock.now()
        self._steps = 0
        self._hot: dict[int, float] = {}
        self._polled: set[int] | None = None  # sensors that answer; None for all
        self._overcurrent: set[int] = set()
        self.schedule = FaultSchedule(start=self._origin)
        for fault in faults:
            self.inject(fault)

    # --- time and faults

    def inject(self, fault: Fault) -> None:
        """Add a fault, its time counted from now."""
        if fault.side in (None, self.side):
            self.schedule.add(fault, self._clock.now())

    @property
    def next_time(self) -> float | None:
        """Time at which a fault begins or ends next, or None."""
        return self.schedule.next_time

    @property
    def tripped(self) -> list[bool]:
        """Whether each motor's time-out protection has tripped."""
        return [motor.tripped for motor in self._motors]

    def advance(self) -> None:
        """Advance motors and faults to the present time."""
        now = self._clock.now()
        while self._now < now or self.schedule.next_time is not None:
            following = self.schedule.next_time
            until = now if following is None else min(now, following)
            until = min(until, *(motor.deadline for motor in self._motors))
            if self._hot:
                until = min(until, self._now + _HOT_SLICE)
            self._advance_motors(max(until, self._now))
            for index, motor in enumerate(self._motors):
                if motor.deadline <= self._now:
                    self._trip(index)
            for fault, begins in self.schedule.poll(self._now):
                self._apply_fault(fault, begins)
            for index, celsius in self._hot.items():
                self.mechanics.heat(index, celsius)
            if until >= now:
                return

    def _advance_motors(self, until: float) -> None:
        self._now = until
        due = int((until - self._origin) / STEP + 1e-6)
        most = int(_MAX_CATCH_UP / STEP)
        if due - self._steps > most:
            self._steps = due - most
        if due > self._steps:
            self.mechanics.step(due - self._steps)
            self._steps = due

    def _trip(self, index: int) -> None:
        motor = self._motors[index]
        motor.deadline = math.inf
        motor.tripped = True
        self.counters.trips += 1
        # without gains FOC is limp
        mode = JointMode.BRAKE if self.firmware.tripped_brakes else JointMode.FOC
        self.mechanics.command(index, mode)
        self._report_drive(index, None)

    def _apply_fault(self, fault: Fault, begins: bool) -> None:
        kind = fault.kind
        if kind in ("stall", "stall-out"):
            self.on_stall("in" if kind == "stall" else "out")
            return
        if kind == "press":
            pressed = {f["sensor"]: f["n"] for f in self.schedule.active_of("press")}
            for index in range(len(DEX3_1.sensors)):
                self.mechanics.press(index, pressed.get(index, 0.0))
            return
        if kind == "unplug":
            self.plugged = not self.schedule.active_of("unplug")
            return
        silent, stuck, overcurrent = (
            {
                index
                for active in self.schedule.active_of(name)
                for index in range(len(self._motors))
                if active.device in (None, index)
            }
            for name in ("silent", "stuck", "overcurrent")
        )
        hot = {
            index: active["c"]
            for active in self.schedule.active_of("overheat")
            for index in range(len(self._motors))
            if active.device in (None, index)
        }
        for index, motor in enumerate(self._motors):
            motor.silent = index in silent
            self.mechanics.jam(index, index in stuck)
            if index in overcurrent and index not in self._overcurrent:
                self.mechanics.fail(index, MotorError.OVERCURRENT)
            elif index in self._overcurrent and index not in overcurrent:
                self.mechanics.recover(index, MotorError.OVERCURRENT)
            if index in self._hot and index not in hot:
                self.mechanics.heat(index, AMBIENT)
        self._overcurrent, self._hot = overcurrent, hot

    # --- frames

    def exchange(self, data: bytes) -> bytes | None:
        """Process one OUT transfer; return the answer, or None without one.

        :attr:`late` is then the delay of the answer, seconds.
        """
        self.advance()
        self.counters.frames += 1
        answering: list[int] | None = None
        self._polled = set() if self.firmware.sensors_polled else None
        try:
            self._check_firmware(data)
            answering = self._apply_frame(data)
        except ChecksumError:
            self.counters.bad_crc += 1
        except WireError:
            self.counters.bad_size += 1
        if answering is None:
            if not self.firmware.answer_bad_frame:
                return None
            answering = list(range(len(self._motors)))
        return self._send(self.state(answering))

    def _check_firmware(self, data: bytes) -> None:
        """Refuse frames that this firmware does not take.

        :raises WireError: it is one.
        """
        if self.firmware.frame not in (None, len(data)):
            raise WireError(f"a frame of {len(data)} bytes")
        if self.firmware.head not in (None, data[:2]):
            raise ChecksumError(f"a frame that starts with {data[:2].hex()}")

    def _apply_frame(self, data: bytes) -> list[int]:
        """Pass each motor its packet; return the indices of the motors that answer.

        :raises WireError: it is not a valid frame.
        """
        silent: set[int] = set()
        commands = self._reader.read(data)
        if commands is None:
            decoded = self._codec.decode_command(data)
            self.counters.damaged_packets += len(decoded.problems)
            silent = set(np.flatnonzero(decoded.silent).tolist())
            self.counters.broadcasts += bool(silent)
            if self._polled is not None:
                places = self.wiring.bus_map.sensors
                asked = {(bus, packet.id) for bus, packet in decoded.frame.sensors}
                self._polled = {i for i, place in enumerate(places) if place in asked}
            commands = _commands_present(decoded)
        for command in commands:
            if not self._motors[command[0]].silent:
                self._command(*command)
        addressed = {index for index, *_ in commands}
        return [
            index
            for index in range(len(self._motors))
            if index not in silent
            and (index in addressed or self.firmware.unaddressed_motors_answer)
        ]

    def _command(self, index: int, status: int, protect: bool, *setpoint: float) -> None:
        motor = self._motors[index]
        known = status in _KNOWN
        if not known and not self.firmware.other_status_brakes:
            self.counters.ignored_packets += 1
            return
        if not protect:
            motor.tripped = False
            motor.deadline = math.inf
        elif motor.tripped:
            # stays stopped until the host acknowledges the trip with bit 7 = 0
            self.counters.ignored_packets += 1
            return
        else:
            motor.deadline = self._now + self.firmware.command_timeout
        self.mechanics.command(index, status if known else JointMode.BRAKE, *setpoint)
        _, dq, tau, kp, kd = setpoint
        drives = status == JointMode.FOC and (kp > 0 or tau != 0 or (kd > 0 and dq != 0))
        self._report_drive(index, (index, status, protect, *setpoint) if drives else None)  # type: ignore[arg-type]

    def _report_drive(self, index: int, command: MotorCommand | None) -> None:
        motor = self._motors[index]
        if self.on_drive is not None and (command is not None or motor.driven):
            self.on_drive(self._now, index, command)
        motor.driven = command is not None

    def state(self, motors: Sequence[int] | None = None) -> bytes:
        """Encode a state frame with the present state.

        :param motors: indices of motors that answer; all by default. Silent ones are left out.
        """
        which = range(len(self._motors)) if motors is None else motors
        heard = [index for index in which if not self._motors[index].silent]
        return self._writer.frame(heard, self.tripped, self._polled)

    def _send(self, answer: bytes) -> bytes | None:
        chance = self._random.random
        counters = self.counters
        if any(chance() < fault["p"] for fault in self.schedule.active_of("drop")):
            counters.dropped += 1
            return None
        if any(chance() < fault["p"] for fault in self.schedule.active_of("corrupt")):
            counters.corrupted += 1
            bit = self._random.randrange(8 * len(answer))
            spoilt = bytearray(answer)
            spoilt[bit // 8] ^= 1 << bit % 8
            answer = bytes(spoilt)
        late = sum(f["ms"] * 1e-3 for f in self.schedule.active_of("delay") if chance() < f["p"])
        counters.delayed += late > 0
        counters.answers += 1
        self.late = late + self.firmware.answer_time
        return answer


def _commands_present(decoded: DecodedCommand) -> list[MotorCommand]:
    command = decoded.command
    assert command.timeout is not None
    return [
        (
            index,
            int(command.mode[index]),
            bool(command.timeout[index]),
            float(command.q[index]),
            float(command.dq[index]),
            float(command.tau[index]),
            float(command.kp[index]),
            float(command.kd[index]),
        )
        for index in np.flatnonzero(decoded.present).tolist()
    ]
