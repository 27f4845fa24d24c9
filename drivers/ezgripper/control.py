"""Plan the servo's goals from commands and samples, without I/O; time comes with the samples.

The phases:

- *limp*: command with kp = 0. The motor carries no current (the springs open the fingers), as
  the vendor's motor with zero gains (docs/sources/unitree-dex.md#b2,
  docs/sources/unitree-dex.md#d10). tau and kd have no effect.
- *brake*: command mode BRAKE, and the time from a recovery to a new command. The fingers are
  stopped and held where they came to rest, at hold effort. Before the first FOC command after
  opening or a recovery, the motor carries no current: the servo leaves it off at power-up
  (docs/sources/mx64-ezgripper.md#b5), and no command has asked for torque.
- *moving*: the fingers move to q, at the effort limit at most, or rest there.
- *contact*: they have stopped before q (:mod:`contact`). The effort limit stays for
  ``hold_after`` seconds, so that the grip closes.
- *holding*: after that the limit falls to the hold effort, because a stalled motor turns all its
  current to heat (docs/sources/mx64-ezgripper.md#d5,
  docs/sources/mx64-ezgripper.md#d6).

kp > 0 selects position control; its value has no effect, because the servo has its own position
loop, whose force Goal Current limits. dq, kd and tau of a position command are ignored
(docs/sources/mx64-ezgripper.md#d10-20).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from dexkit.drivers.ezgripper.contact import MIN_FREE_SPEED, Contact, ContactDetector
from dexkit.drivers.ezgripper.register_block import Goal, Sample
from dexkit.drivers.ezgripper.scaling import (
    STROKE,
    current_of_effort,
    profile_velocity,
    relative_position,
    ticks_of_joint,
)
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, JointMode
from dexkit.wire import mx64

__all__ = ["Control", "ControlSettings", "Phase", "without_profile"]


class Phase(str, Enum):
    """Phase of the gripper's control; see the module's docstring."""

    LIMP = "limp"
    BRAKE = "brake"
    MOVING = "moving"
    CONTACT = "contact"
    HOLDING = "holding"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class ControlSettings:
    """Limits and times that a user may set.

    :param effort: limit while moving and at first contact, percent
        (docs/sources/mx64-ezgripper.md#d2, docs/sources/mx64-ezgripper.md#d3).
    :param hold_effort: limit while holding an object, while braking, and while hot, percent.
    :param hold_after: seconds of contact after which the limit falls to ``hold_effort``
        (docs/sources/mx64-ezgripper.md#d5).
    :param speed: limit, percent of stroke a second. At 12 V the motor reaches 172 without load
        (docs/sources/mx64-ezgripper.md#d1). A faster profile runs ahead of the fingers and delays a
        reversal until it has come back.
    :param startup_speed: the same limit from opening until the fingers first rest at their goal.
    :param startup_time: seconds after which the start-up limit ends in any case.
    :param warm: °C at and above which the limit is ``hold_effort`` for every command.
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
            # slower motion cannot be distinguished from contact
            if not least <= value <= 1000:
                raise UsageError(f"{name} must be {least:g} to 1000 %/s, not {value:g}")
        for name in ("hold_after", "startup_time"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise UsageError(f"{name} must not be negative or infinite, got {value:g}")
        if not 0 < self.warm <= 80:
            raise UsageError(f"warm must be within 0 and 80 degrees, not {self.warm:g}")


_AT_GOAL = 25
"""Ticks (1 %) from the goal within which the fingers count as arrived
(docs/sources/mx64-ezgripper.md#d5)."""
_STILL = 2
"""Velocity units (31 ticks/s, 1.3 %/s) below which the fingers count as stopped."""
_REST_TIME = 0.2
"""Seconds at the goal that end the start-up limit."""
_COOL_HYSTERESIS = 5.0
"""°C below ``warm`` at which the full effort is allowed again."""


def without_profile(position: int, current: int) -> Goal:
    """Return a goal that makes the servo's trajectory jump to the fingers' position.

    While the fingers are blocked, the servo's profile runs on to its goal, and the next profile
    starts there, so opening would be delayed until the profile has come back. With a Profile
    Velocity of 0 the trajectory jumps to the goal (docs/sources/mx64-ezgripper.md#b5).
    """
    return Goal(_clamp_to_stroke(position), current, 0)


class Control:
    """Plans the goal of each exchange from the newest command and the newest sample.

    :param zero: calibrated zero, ticks, in any turn.
    :param stroke: ticks from closed to open.

    :ivar partner_reduced: the other servo of the gripper is hot or was overloaded, so that the
        effort of this one is reduced, too.
    """

    def __init__(
        self, zero: int, settings: ControlSettings | None = None, *, stroke: int = STROKE
    ) -> None:
        self.zero = zero
        self.stroke = stroke
        self.partner_reduced = False
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
        """The present contact, or None."""
        return self.detector.contact

    @property
    def reduced(self) -> bool:
        """Whether the servo is hot or was overloaded, so that its effort is reduced."""
        return self._warm or self._overloaded_at is not None

    def position(self, sample: Sample) -> int:
        """Return a sample's position, ticks from the zero."""
        return relative_position(sample.position, self.zero, self.stroke)

    def recovered(self, command: HandCommand | None, *, overload_at: float | None = None) -> None:
        """Start over after a servo reboot: no torque until a command differs from ``command``.

        :param command: the command at the time of the fault; None accepts any command.
        :param overload_at: position of the overload, ticks from the zero, or None for another
            fault. The effort stays at ``hold_effort`` until a command opens the gripper from there,
            so that the same load does not cause another overload.
        """
        self._refused = command
        self._commanded = False
        if overload_at is not None:
            self._overloaded_at = overload_at
        self._braked_at = None
        self.detector.reset()
        self._start_up()

    def plan(self, command: HandCommand, sample: Sample) -> Goal:
        """Return the goal for ``command``, given the newest sample."""
        now = sample.time
        position = self.position(sample)
        base = sample.position - position
        braking = int(command.mode[0]) == JointMode.BRAKE  # numpy compares enums slowly
        # the service brakes during the fault; that brake does not make the old command new
        if self._refused is not None and not braking and not command.same_as(self._refused):
            self._refused = None
        goal: Goal
        if self._refused is None and not braking:
            self._commanded = True
        if not self._commanded:
            self._leave_drive(Phase.BRAKE)
            goal = Goal(_clamp_to_stroke(sample.position), 0, self._profile_velocity())
        elif braking:
            goal = self._brake(sample, position, base)
        elif command.kp[0] <= 0:
            self._leave_drive(Phase.LIMP)
            goal = Goal(_clamp_to_stroke(sample.position), 0, self._profile_velocity())
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
            # hold the position of the stop: returning to an earlier one would be a new motion
            self._braking = 0
            self._braked_at = position
            return without_profile(sample.position, current_of_effort(settings.effort))
        effort = settings.effort if self._braking else settings.hold_effort
        current = current_of_effort(min(effort, settings.effort))
        return Goal(_clamp_to_stroke(base + self._braked_at), current, self._profile_velocity())

    def _drive(
        self, command: HandCommand, sample: Sample, now: float, position: int, base: int
    ) -> Goal:
        settings = self.settings
        self._braked_at = None
        target = ticks_of_joint(float(command.q[0]), self.stroke)
        held = self.detector.contact
        contact = self.detector.update(now, position, target, received=sample.received)
        self._end_startup(now, abs(target - position) <= _AT_GOAL)
        self._warm = sample.temperature >= settings.warm - (_COOL_HYSTERESIS if self._warm else 0.0)
        if self._overloaded_at is not None and target > self._overloaded_at + _AT_GOAL:
            self._overloaded_at = None
        if contact is None:
            self.phase = Phase.MOVING
        elif now - contact.since < settings.hold_after:
            self.phase = Phase.CONTACT
        else:
            self.phase = Phase.HOLDING
        effort = settings.effort
        if self.phase is Phase.HOLDING or self.reduced or self.partner_reduced:
            effort = min(effort, settings.hold_effort)
        current = current_of_effort(effort)
        if held is not None and contact is None:
            return without_profile(sample.position, current)
        return Goal(_clamp_to_stroke(base + target), current, self._profile_velocity())

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

    def _profile_velocity(self) -> int:
        settings = self.settings
        speed = min(settings.speed, settings.startup_speed) if self._starting else settings.speed
        return profile_velocity(speed, self.stroke)


def _clamp_to_stroke(ticks: int) -> int:
    return min(max(ticks, -mx64.POSITION_SPAN), mx64.POSITION_SPAN)
