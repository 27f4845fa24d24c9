"""Move one motor slowly until it arrives or stalls, with as little torque as does it; sans-IO.

The command leads the measured position by so little that stiffness times lead is the torque that is
allowed, so that what blocks the joint is pushed with that torque and no more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from dexkit.bringup.bench import Drive, Plan, Reading, Snapshot
from dexkit.errors import HandFault, UsageError
from dexkit.hand import MotorError

__all__ = ["Effort", "End", "Go", "Mover", "check_motors"]


@dataclass(frozen=True)
class Effort:
    """Limits of torque and speed for the motions.

    :param torque: N·m at the joint, at most. Motion starts with a quarter of it.
    :param speed: rad/s.
    :param most_torque: what the plan of the hand allows.
    """

    torque: float = Plan.torque
    speed: float = Plan.speed
    most_torque: float = Plan.most_torque

    def __post_init__(self) -> None:
        if not 0.01 <= self.torque <= self.most_torque:
            raise UsageError(f"torque is 0.01 to {self.most_torque:g} N·m, not {self.torque:g}")
        if not 0.02 <= self.speed <= 2.0:
            raise UsageError(f"speed is 0.02 to 2 rad/s, not {self.speed:g}")

    @classmethod
    def from_plan(
        cls, plan: Plan, torque: float | None = None, speed: float | None = None
    ) -> Effort:
        """Use the given limits, or else those of the plan.

        :raises UsageError: it is more than the plan allows.
        """
        return cls(
            plan.torque if torque is None else torque,
            plan.speed if speed is None else speed,
            plan.most_torque,
        )


KP = 1.5
"""N·m/rad: the stiffness of xr_teleoperate's commands (docs/sources/unitree-dex.md#b1)."""
KD = 0.05
_LEVELS = (0.25, 0.5, 1.0)
"""Parts of the torque that are tried one after the other."""
_STALL_TIME = 0.4
"""Seconds without progress until the next level, and behind the last one until a stall."""
_PROGRESS = 0.004  # rad
_ARRIVED = 0.01  # rad
_NEAR = 0.05  # rad, where friction may hold the joint
_WRONG_WAY = 0.06  # rad
_RUNAWAY = 0.2  # rad ahead of the command
_OTHERS = 0.1  # rad that another motor may yield
_HOT = 60.0
"""°C of a motor's case or winding at which nothing is driven: far below what small motions need."""
_SILENT = 3
"""Answers in a row without a motor."""
_LONGEST_STEP = 0.05  # s
_REST_SPEED = 0.25  # rad/s, a count of position in two exchanges
_SETTLING = 1.0
"""Seconds that a motor gets to come to rest before a motion begins."""


class End(str, Enum):
    """Reason for the end of a motion."""

    ARRIVED = "arrived"
    STALLED = "stalled"


@dataclass(frozen=True)
class Go:
    """Move one motor to ``target``, rad in the motor's own direction."""

    motor: str
    target: float
    why: str


def check_motors(snapshot: Snapshot) -> None:
    """Stop the bring-up where a motor reports a fault or is hot.

    :raises HandFault: naming the motor and the fault.
    """
    for address, reading in snapshot.motors.items():
        fault = reading.fault
        if fault:
            names = [str(b.name).lower().replace("_", " ") for b in MotorError if b and b & fault]
            raise HandFault(
                f"motor {address} reports {' and '.join(names) or f'error bits {fault:#x}'}",
                hint="find the cause; then run the same command again: it goes on where it was",
            )
        if reading.temperature >= _HOT:
            raise HandFault(
                f"motor {address} is at {reading.temperature:.0f} °C",
                hint=f"let it cool below {_HOT:g} °C; then run the same command again",
            )


class Mover:
    """One motion.

    :param widest: how much stronger the joint may be than the motor's torque says.
    """

    def __init__(self, go: Go, effort: Effort, widest: float) -> None:
        self.go = go
        self.q = math.nan
        self._speed = effort.speed
        self._torque = effort.torque / widest
        self._resting: Mapping[str, Reading] = {}
        self._silent = 0
        self._running = False
        self._before: tuple[float, float] | None = None
        self._waiting_since = 0.0
        self._time = 0.0

    def _at_rest(self, now: float, q: float) -> bool:
        """Whether the motor has come to rest after the motion before this one.

        Driven back at once, it would run on for a while: no motor that moves against its command.
        """
        before, self._before = self._before, (now, q)
        if before is None:
            self._waiting_since = now
            return False
        since, last = before
        slow = abs(q - last) <= _REST_SPEED * (now - since)
        return slow or now - self._waiting_since > _SETTLING

    def _start(self, now: float, snapshot: Snapshot, q: float) -> None:
        self._running = True
        self._begin = self._carrot = self._mark = q
        self._marked = self._time = now
        self._level = 0
        self._resting = snapshot.motors
        self._before = None

    def step(self, now: float, snapshot: Snapshot, held: bool) -> Drive | End | None:
        """Return the command to send now, the reason for the end of the motion, or None to lock
        every motor.

        :param held: the dead-man key; whenever it was not, motion starts gently again.
        :raises HandFault: a fault, a silent motor, one that moves against its command, ahead of
            it, or without one.
        """
        check_motors(snapshot)
        reading = snapshot.motors.get(self.go.motor)
        if reading is None:
            self._silent += 1
            self._running = False
            if self._silent >= _SILENT:
                raise HandFault(
                    f"motor {self.go.motor} no longer answers",
                    hint="check its cable and its supply; then run the same command again: it "
                    "goes on where it was",
                )
            return None
        self._silent = 0
        self.q = q = reading.q
        if not held:
            self._running = False
            self._before = None
            return None
        if not self._running:
            if not self._at_rest(now, q):
                return None
            self._start(now, snapshot, q)
        self._check_motion(q, snapshot)
        way = self.go.target - q
        if abs(way) < _ARRIVED:
            return End.ARRIVED
        if abs(q - self._mark) > _PROGRESS:
            self._mark, self._marked = q, now
        elif now - self._marked > _STALL_TIME:
            if self._level == len(_LEVELS) - 1:
                return End.ARRIVED if abs(way) < _NEAR else End.STALLED
            self._level += 1
            self._marked = now
        torque = self._torque * _LEVELS[self._level]
        return Drive(self.go.motor, self._advance(now, q, torque / KP), KP, KD, torque)

    def _advance(self, now: float, q: float, lead: float) -> float:
        step = self._speed * min(now - self._time, _LONGEST_STEP)
        self._time = now
        if self.go.target > q:
            self._carrot = min(self._carrot + step, q + lead, self.go.target)
        else:
            self._carrot = max(self._carrot - step, q - lead, self.go.target)
        return self._carrot

    def _check_motion(self, q: float, snapshot: Snapshot) -> None:
        towards = math.copysign(1.0, self.go.target - self._begin)
        if (q - self._begin) * towards < -_WRONG_WAY:
            raise HandFault(
                f"motor {self.go.motor} moves against its command",
                hint="does something push the joint? If not, its position or torque has another "
                "direction than the manual's, and dexkit must not drive it",
            )
        if (q - self._carrot) * towards > _RUNAWAY:
            raise HandFault(
                f"motor {self.go.motor} is {abs(q - self._carrot):.2f} rad ahead of its command",
                hint="does something pull the joint? If not, the motor obeys neither the speed nor "
                "the torque that it is given, and dexkit must not drive it",
            )
        for address, before in self._resting.items():
            now = snapshot.motors.get(address)
            if address != self.go.motor and now and abs(now.q - before.q) > _OTHERS:
                raise HandFault(
                    f"motor {address} moves while only {self.go.motor} is driven",
                    hint="does the joint push another one? Make room; then run the same command "
                    "again",
                )
