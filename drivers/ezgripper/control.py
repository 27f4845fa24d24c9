"""From commands and samples to goals: the gripper's behaviour without the servo.

Pure logic on the injected time. The phases:

- *limp*: command with kp = 0. The motor carries no current (the springs open the fingers), as
  the vendor's motor with zero gains (docs/sources/unitree-dex.md#b2,
  docs/sources/unitree-dex.md#d10). tau and kd do not act.
- *brake*: command mode BRAKE, and the time after a recovery until a new command comes. The
  fingers are stopped and then held where they came to rest, at hold effort. Before the first FOC
  command since opening or since a recovery there is nothing to brake: the motor carries no current,
  as the servo itself leaves it off at power-up (docs/sources/mx64-ezgripper.md#b5), and nobody has
  asked for torque.
- *moving*: the fingers go to q at most at the effort limit, or rest there.
- *contact*: they are stopped short of q (:mod:`contact`). For ``hold_after`` seconds the effort
  stays, so that the grip closes.
- *holding*: contact that lasts: the limit sinks to the hold effort, because a stalled motor
  turns all its current to heat (docs/sources/mx64-ezgripper.md#d5,
  docs/sources/mx64-ezgripper.md#d6).

kp > 0 selects position control, its size does not matter: the servo has a position loop of its
own, whose force is bounded by Goal Current. dq, kd and tau of a position command are ignored
(docs/sources/mx64-ezgripper.md#d10-20).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from dexkit.drivers.ezgripper.block import Goal, Sample
from dexkit.drivers.ezgripper.contact import MIN_FREE_SPEED, Contact, ContactDetector
from dexkit.drivers.ezgripper.scaling import (
    current_of_effort,
    profile_velocity,
    relative_position,
    ticks_of_joint,
)
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, JointMode
from dexkit.wire import mx64

__all__ = ["Control", "ControlSettings", "Phase", "at_once"]


class Phase(str, Enum):
    """What the gripper is doing; see the module's text."""

    LIMP = "limp"
    BRAKE = "brake"
    MOVING = "moving"
    CONTACT = "contact"
    HOLDING = "holding"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class ControlSettings:
    """What a user may set of the behaviour.

    :param effort: limit while moving and at first contact, percent
        (docs/sources/mx64-ezgripper.md#d2, docs/sources/mx64-ezgripper.md#d3).
    :param hold_effort: limit while an object is held, braking, or hot, percent.
    :param hold_after: seconds of contact after which the limit sinks to ``hold_effort``
        (docs/sources/mx64-ezgripper.md#d5).
    :param speed: limit, percent of stroke a second. At 12 V the motor can do 172 without load
        (docs/sources/mx64-ezgripper.md#d1); a profile that it cannot follow runs ahead, and a
        reversal waits until it is back.
    :param startup_speed: the same from opening until the fingers have once come to rest at
        their goal.
    :param startup_time: seconds after which the start-up limit ends in any case.
    :param warm: °C from which the limit is ``hold_effort``, whatever is commanded.
    """

    effort: float = 50.0
    hold_effort: float = 15.0
    hold_after: float = 0.5
    speed: float = 150.0
    startup_speed: float = 50.0
    startup_time: float = 3.0
    warm: float = 70.0

    def __post_init__(self) -> None:
        for name in ("effort", "hold_effort"):
            value = getattr(self, name)
            if not 0 < value <= 100:
                raise UsageError(f"{name} must be within 0 and 100 percent, not {value:g}")
        least = 2 * MIN_FREE_SPEED
        for name in ("speed", "startup_speed"):
            value = getattr(self, name)
            # slower motion could not be told from contact
            if not least <= value <= 1000:
                raise UsageError(f"{name} must be {least:g} to 1000 %/s, not {value:g}")
        for name in ("hold_after", "startup_time"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise UsageError(f"{name} must not be negative or infinite, got {value:g}")
        if not 0 < self.warm <= 80:
            raise UsageError(f"warm must be within 0 and 80 degrees, not {self.warm:g}")


_ARRIVED = 25
"""Ticks (1 %) from the goal within which the fingers count as there
(docs/sources/mx64-ezgripper.md#d5)."""
_STILL = 2
"""Velocity units (31 ticks/s, 1.3 %/s) below which the fingers count as stopped."""
_REST_TIME = 0.2
"""Seconds at the goal that end the start-up limit."""
_COOLED = 5.0
"""°C below ``warm`` at which the full effort comes back."""


def at_once(position: int, current: int) -> Goal:
    """A goal for one exchange that brings the servo's trajectory back to where the fingers are.

    While fingers are blocked the servo's profile runs on to its goal, and the next profile
    starts from there: told to open, the fingers would wait until it has come all the way back.
    A Profile Velocity of 0 makes the trajectory jump to the goal
    (docs/sources/mx64-ezgripper.md#b5).
    """
    return Goal(_bounded(position), current, 0)


class Control:
    """Plans the goal of each exchange from the newest command and the newest sample.

    :param zero: calibrated zero, ticks, in any turn.
    """

    def __init__(self, zero: int, settings: ControlSettings | None = None) -> None:
        self.zero = zero
        self.settings = settings if settings is not None else ControlSettings()
        self.detector = ContactDetector()
        self.phase = Phase.LIMP
        self._braked_at: int | None = None
        self._braking = 0
        self._refused: HandCommand | None = None
        self._commanded = False  # since opening or the last recovery
        self._overloaded_at: float | None = None
        self._warm = False
        self._start_up()

    def _start_up(self) -> None:
        self._starting = True
        self._started: float | None = None
        self._resting: float | None = None

    @property
    def contact(self) -> Contact | None:
        """The contact in force, or None."""
        return self.detector.contact

    def position(self, sample: Sample) -> int:
        """Ticks from the zero."""
        return relative_position(sample.position, self.zero)

    def recovered(self, command: HandCommand | None, *, overload_at: float | None = None) -> None:
        """The servo has been restarted: no torque until a command differs from ``command``.

        :param command: the one in force when the fault came; None lets any command through.
        :param overload_at: position of the overload, ticks from the zero, or None for another
            fault. The effort stays at ``hold_effort`` until the gripper is told to open from
            there, so that the same load does not trip it again.
        """
        self._refused = command
        self._commanded = False
        if overload_at is not None:
            self._overloaded_at = overload_at
        self._braked_at = None
        self.detector.reset()
        self._start_up()

    def plan(self, command: HandCommand, sample: Sample) -> Goal:
        """The goal for ``command``, given the newest sample."""
        now = sample.time
        position = self.position(sample)
        base = sample.position - position
        braking = command.mode[0] == JointMode.BRAKE
        # a brake in between (the service's, while the fault lasted) does not make it new
        if self._refused is not None and not braking and not command.same_as(self._refused):
            self._refused = None
        goal: Goal
        if self._refused is None and not braking:
            self._commanded = True
        if not self._commanded:
            self._leave_drive(Phase.BRAKE)
            goal = Goal(_bounded(sample.position), 0, self._profile())
        elif braking:
            goal = self._brake(sample, position, base)
        elif command.kp[0] <= 0:
            self._leave_drive(Phase.LIMP)
            goal = Goal(_bounded(sample.position), 0, self._profile())
        else:
            goal = self._drive(command, sample, now, position, base)
        return goal

    def _leave_drive(self, phase: Phase) -> None:
        self.phase = phase
        self.detector.reset()
        self._resting = None
        if phase is not Phase.BRAKE:
            self._braked_at = None

    def _brake(self, sample: Sample, position: int, base: int) -> Goal:
        self._leave_drive(Phase.BRAKE)
        settings = self.settings
        still = abs(sample.velocity) <= _STILL
        if self._braked_at is None:
            self._braked_at = position
            self._braking = 0 if still else (1 if sample.velocity > 0 else -1)
        elif self._braking and (still or sample.velocity * self._braking < 0):
            # where it came to a stop is where it stays: going back would be a new motion
            self._braking = 0
            self._braked_at = position
            return at_once(sample.position, current_of_effort(settings.effort))
        effort = settings.effort if self._braking else settings.hold_effort
        current = current_of_effort(min(effort, settings.effort))
        return Goal(_bounded(base + self._braked_at), current, self._profile())

    def _drive(
        self, command: HandCommand, sample: Sample, now: float, position: int, base: int
    ) -> Goal:
        settings = self.settings
        self._braked_at = None
        target = ticks_of_joint(float(command.q[0]))
        held = self.detector.contact
        contact = self.detector.update(now, position, target)
        self._end_startup(now, abs(target - position) <= _ARRIVED)
        self._warm = sample.temperature >= settings.warm - (_COOLED if self._warm else 0.0)
        if self._overloaded_at is not None and target > self._overloaded_at + _ARRIVED:
            self._overloaded_at = None
        if contact is None:
            self.phase = Phase.MOVING
        elif now - contact.since < settings.hold_after:
            self.phase = Phase.CONTACT
        else:
            self.phase = Phase.HOLDING
        effort = settings.effort
        if self.phase is Phase.HOLDING or self._warm or self._overloaded_at is not None:
            effort = min(effort, settings.hold_effort)
        current = current_of_effort(effort)
        if held is not None and contact is None:
            return at_once(sample.position, current)
        return Goal(_bounded(base + target), current, self._profile())

    def _end_startup(self, now: float, at_goal: bool) -> None:
        if not self._starting:
            return
        if self._started is None:
            self._started = now
        if not at_goal:
            self._resting = None
        elif self._resting is None:
            self._resting = now
        rested = self._resting is not None and now - self._resting >= _REST_TIME
        if rested or now - self._started >= self.settings.startup_time:
            self._starting = False

    def _profile(self) -> int:
        settings = self.settings
        speed = min(settings.speed, settings.startup_speed) if self._starting else settings.speed
        return profile_velocity(speed)


def _bounded(ticks: int) -> int:
    return min(max(ticks, -mx64.POSITION_SPAN), mx64.POSITION_SPAN)
