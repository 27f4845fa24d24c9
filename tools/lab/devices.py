"""The emulated devices of the lab, on this machine, and a record of every command that moves one.

They run outside the guest, at this machine's full speed; the guest's kernel reaches them by
USB/IP. A :class:`Record` notes what the guest cannot know: which set-points really reached a motor
and where the joints really were.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from dexkit.clock import RealClock
from dexkit.emulators.dex1_mechanics import Dex1Mechanics
from dexkit.emulators.dex3_mcu import Dex3Hands
from dexkit.emulators.ftdi import FT232H, FT232R, FtdiPort, FtdiUsb
from dexkit.emulators.m4010 import Bus as MotorBus
from dexkit.emulators.m4010 import Motor
from dexkit.emulators.m4010.motor import LOCKING
from dexkit.emulators.mx64 import Bus as ServoBus
from dexkit.emulators.mx64 import Servo
from dexkit.hand import Side
from dexkit.models import DEX1_1
from dexkit.wire import mx64

__all__ = ["ADAPTERS", "Devices", "Record"]

ADAPTERS = ("DKLAB001", "DKLAB002", "DKLAB003")
"""Serial numbers of the USB-serial adapters: the MX-64's, the Dex1-1 motor's, and that of one that
only takes a USB port."""
_PERIOD = 0.01  # seconds between two looks at the joints
_LOOK_STEPS = 20  # of a motor's mechanics, 10 ms
_FOC = 1
_MOTION = 1e-3  # of a joint, in the record's unit, that is none


class Record:
    """Where one device's joints were, and which set-points it took.

    :param positions: of the joints now.
    """

    def __init__(self, positions: Callable[[], Sequence[float]]) -> None:
        self._positions = positions
        self._places: list[tuple[float, list[float]]] = []
        self._setpoints: list[tuple[float, tuple[object, ...]]] = []
        self._last: dict[int, tuple[object, ...]] = {}  # of the joints that are driven
        self._released = 0.0  # when the last of them was no longer
        self._clock = RealClock()
        self._lock = threading.Lock()

    def note_positions(self) -> None:
        """Note where the joints are."""
        place = [float(q) for q in self._positions()]
        with self._lock:
            self._places.append((self._clock.now(), place))

    def setpoint(self, joint: int, *values: object) -> None:
        """Note a command that can move ``joint``; nothing is noted while it stays the same."""
        if self._last.get(joint) != values:
            self._last[joint] = values
            with self._lock:
                self._setpoints.append((self._clock.now(), values))

    def rests(self, joint: int) -> None:
        """Note that ``joint`` was told to brake, or has no torque."""
        if self._last.pop(joint, None) is not None and not self._last:
            self._released = self._clock.now()

    def now(self) -> dict[str, Any]:
        """The time, and where the joints are."""
        return {"t": self._clock.now(), "q": [float(q) for q in self._positions()]}

    def since(self, start: float) -> dict[str, Any]:
        """What happened since ``start``: extremes of the joints, and how many set-points came."""
        self.note_positions()
        with self._lock:
            places = [place for t, place in self._places if t >= start]
            setpoints = [values for t, values in self._setpoints if t >= start]
        columns = list(zip(*places, strict=True))
        return {
            "low": [min(column) for column in columns],
            "high": [max(column) for column in columns],
            "q": places[-1],
            "setpoints": len(setpoints),
            "last": repr(setpoints[-1:]),
        }

    def stopped(self, start: float) -> dict[str, float | None]:
        """How long after ``start`` the joints moved, and a motor was driven.

        :returns: seconds ``still`` until no joint moved any more, and ``released`` until no motor
            was driven; ``released`` is None while one is.
        """
        self.note_positions()
        with self._lock:
            places = [(t, place) for t, place in self._places if t >= start]
            released = None if self._last else max(0.0, self._released - start)
        rest = places[-1][1]
        moving = [
            t
            for t, place in places
            if any(abs(q - end) > _MOTION for q, end in zip(place, rest, strict=True))
        ]
        return {"still": moving[-1] - start if moving else 0.0, "released": released}


class Devices:
    """Both Dex3-1 hands on one USB/IP server; an MX-64 and a Dex1-1 motor behind adapters, and an
    adapter to take a port.

    :ivar records: of ``left`` and ``right`` (rad), ``mx64`` (percent of opening) and ``dex1``
        (rad).
    """

    def __init__(self) -> None:
        now = RealClock().now()
        self.hands = Dex3Hands(tuple(Side))
        servo = Servo(1, baudrate=1_000_000, now=now)
        motor = Motor(
            DEX1_1.vendor_ids[Side.LEFT], mechanics=Dex1Mechanics(locking=LOCKING), now=now
        )
        self.adapters = FtdiPort(
            [
                FtdiUsb(ServoBus([servo], start=now), ADAPTERS[0], model=FT232R),
                FtdiUsb(MotorBus([motor], start=now), ADAPTERS[1], model=FT232H),
                FtdiUsb(ServoBus([Servo(1, now=now)], start=now), ADAPTERS[2], model=FT232R),
            ]
        )
        self.adapters.start()
        self.records = {
            **{str(side): _record_hand(self.hands.device(side).mechanics) for side in Side},
            "mx64": _record_servo(servo),
            "dex1": _record_motor(motor),
        }
        self._stopping = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="record", daemon=True)
        self._watcher.start()

    def _watch(self) -> None:
        while not self._stopping.wait(_PERIOD):
            for record in self.records.values():
                record.note_positions()

    @property
    def failure(self) -> BaseException | None:
        """What went wrong inside an emulator, if anything did."""
        lines = [adapter.line.failure for adapter in self.adapters.adapters]
        servers = [self.hands.error, self.hands.failure, self.adapters.error]
        return next((e for e in [*servers, self.adapters.failure, *lines] if e is not None), None)

    def close(self) -> None:
        """Stop all of them."""
        self._stopping.set()
        self._watcher.join()
        self.hands.close()
        self.adapters.close()


def _record_hand(mechanics: Any) -> Record:
    record = Record(lambda: mechanics.q)
    obey = mechanics.command

    def command(joint: int, mode: int, *setpoint: float) -> None:
        q, dq, tau, kp, kd = (*setpoint, *[0.0] * (5 - len(setpoint)))
        if mode == _FOC and (kp > 0 or tau or (kd > 0 and dq)):
            record.setpoint(joint, q, dq, tau, kp, kd)
        else:
            record.rests(joint)
        obey(joint, mode, *setpoint)

    mechanics.command = command
    return record


def _record_servo(servo: Any) -> Record:
    record = Record(lambda: [servo.drive.opening])
    write = servo.write_block

    def write_block(*arguments: Any, **options: Any) -> Any:
        done = write(*arguments, **options)
        # without current the motor is off, whatever its goal: the driver's brake after opening
        if servo.torque and servo.get(mx64.GOAL_CURRENT):
            goals = (mx64.GOAL_POSITION, mx64.GOAL_CURRENT, mx64.GOAL_VELOCITY)
            record.setpoint(0, *(servo.get(item) for item in goals))
        else:
            record.rests(0)
        return done

    servo.write_block = write_block
    return record


def _record_motor(motor: Any) -> Record:
    mechanics = motor.mechanics
    record = Record(lambda: [mechanics.joint.q])
    drive, brake = mechanics.drive, mechanics.brake

    def driven(q: float, dq: float, tau: float, kp: float, kd: float) -> None:
        if kp > 0 or tau or (kd > 0 and dq):
            record.setpoint(0, q, dq, tau, kp, kd)
        else:
            record.rests(0)
        drive(q, dq, tau, kp, kd)

    def braked() -> None:
        record.rests(0)
        brake()

    def stepped(n: int = 1) -> None:
        # an overshoot is shorter than what a busy machine leaves between two looks
        for first in range(0, n, _LOOK_STEPS):
            step(min(_LOOK_STEPS, n - first))
            record.note_positions()

    step = mechanics.step
    mechanics.drive, mechanics.brake, mechanics.step = driven, braked, stepped
    return record
