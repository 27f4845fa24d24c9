"""Choices of makers that a client notices and can work with: what differs from the original.

A hand with friction, a position servo in place of the control law, a hand without force sensors, of
which one side is served: a client of the original works with each, or knows from the claims what it
does not get. No MUST may blame them. ``warned`` names the requirements that may warn of them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from dexkit.conformance.faults.generated.good import (
    FOUND,
    FOUND_GROUPS,
    Backlash,
    Counts,
    Mechanics,
    SoftStart,
    add,
)
from dexkit.conformance.faults.generated.rig import Faulty, Motors, Report, What
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.hand import Side

__all__ = ["DEVIATIONS", "GROUPS"]


class _Friction(What):
    """Dry friction, as a part of the joint's torque.

    Of a hand that obeys gains, the torque is what the client's give over the joint's range, where
    this is less: friction of a tenth of it leaves a joint a tenth of the range short of its goal.
    """

    part = 0.0
    done = False

    def tick(self, dt: float, active: bool) -> None:
        if self.done:
            return
        self.done = True
        hand = self.rig.hand_of(self.side)
        kp, kd = self.rig.gains(0)
        # a step of the reference divides torques by this, and not the dry friction
        implicit = 1.0 + dt * (hand.viscous + kd + dt * kp) / hand.inertia
        hand.coulomb = self.part * min(map(self._torque, self.joints)) / implicit

    def _torque(self, joint: int) -> float:
        hand = self.rig.hand_of(self.side)
        most = hand.tau_max if self.rig.codec.joints == 1 else float(hand.most[joint])
        kp, _ = self.rig.gains(joint)
        return float(min(most, kp * self.span(joint)) if kp else most)


_SLUGGISH = frozenset(
    f"{hand}-{number}"
    for hand in ("DEX1", "DEX3", "DEX5", "BRAINCO", "DFX", "FTP")
    for number in (
        *("GAIN-02", "GAIN-03", "GAIN-04", "GAIN-05", "MODE-05", "MOVE-04", "SENS-08"),
        *("OPER-01", "TRACK-01"),
    )
)
"""The client's torques are small, so that friction makes a hand slow, and stops it short."""
for _percent in (2, 5, 10):
    add(
        "friction",
        _Friction,
        f"friction-{_percent}",
        f"has dry friction of {_percent} % of its torque",
        part=_percent / 100,
        # a tenth of the range off is harm: the Dex5-1's sideways joints have the weakest gains
        not_of={"dex5-1"} if _percent == 10 else frozenset(),
        warned=_SLUGGISH,
    )
add(
    "friction",
    _Friction,
    "friction-20",
    "has a gear with dry friction of a fifth of its torque",
    part=0.2,
    position_servo=True,
    warned=_SLUGGISH,
)
add("backlash", Backlash, "backlash-1", "has play of 1 % of the range", play=0.01)
add("start", SoftStart, "soft-start-0.3", "raises its torque within 0.3 s", seconds=0.3)
add("mechanics", Mechanics, "quick", "has half of the viscous friction", factors={"viscous": 0.5})
add(
    "speed",
    Mechanics,
    "half-speed",
    "moves at half of the speed",
    factors={"full": 0.5},
    position_servo=True,
    warned=_SLUGGISH,
)
add(
    "speed",
    Mechanics,
    "twice-speed",
    "moves at twice the speed",
    factors={"full": 2.0},
    position_servo=True,
)


class _Slow(What):
    """Its goal moves to q of a command with a speed of its own."""

    seconds = 1.0
    goal: Any = None
    """The goal in force, as this has changed it."""

    def __init__(self, rig: Faulty, side: Side, joints: tuple[int, ...]) -> None:
        super().__init__(rig, side, joints)
        self.target: list[float] = []
        self.place: list[float] = []

    def tick(self, dt: float, active: bool) -> None:
        if not self.rig.driven(self.side):
            self.goal, self.place = None, []
            return
        hand, single = self.rig.hand_of(self.side), self.rig.codec.joints == 1
        if hand.goal is not self.goal:
            self.target = [hand.goal.q] if single else hand.goal.tolist()
        here = self.rig.positions(self.side)
        gains = [hand.goal.kp] if single else hand.kp.tolist()
        driven = [True] if single else hand.driven.tolist()
        before, self.place = self.place or list(here), []
        for joint, (at, to) in enumerate(zip(before, self.target, strict=True)):
            most = dt * self.span(joint) / self.seconds
            if (at - here[joint]) * (to - here[joint]) < 0.0:
                at = here[joint]  # it turns round where it is
            led = at + min(max(to - at, -most), most)
            self.place.append(led if gains[joint] and driven[joint] else here[joint])
        if single:
            self.goal = hand.goal = replace(hand.goal, q=self.place[0])
        elif hand.goal is not self.goal or self.place != before:
            self.goal = hand.goal = np.array(self.place)
            hand.changed()


for _seconds in (1.0, 1.6):
    add(
        "speed",
        _Slow,
        f"stroke-{_seconds:g}",
        f"takes {_seconds:g} s for a stroke",
        seconds=_seconds,
        control_law=True,
        warned=_SLUGGISH,
    )


# ------------------------------------------------------------------------------ other controllers

_SERVO = frozenset(
    f"{hand}-{number}"
    for hand, numbers in {
        "DEX1": ("GAIN-02", "GAIN-03", "GAIN-05"),
        "DEX3": ("GAIN-02", "GAIN-03", "GAIN-04"),
        "DEX5": ("GAIN-02", "GAIN-03", "GAIN-04"),
    }.items()
    for number in numbers
)
"""A position servo uses neither the gains nor the velocity nor the torque of a command."""


_FORCE_OF_ITS_OWN = frozenset({"DEX3-FORCE-05", "DEX5-FORCE-05"})
"""What it presses with is not the torque that the gains of a command give."""


class _PositionServo(What):
    """Follows q with its own gains; a command without gains lets it go."""

    part = 1.0
    """Its stiffness, in those of the client."""

    def command(self, motors: Motors) -> Motors | None:
        def served(joint: int, motor: Motor) -> Motor:
            if not all(map(math.isfinite, (motor.q, motor.dq, motor.tau, motor.kp, motor.kd))):
                return motor  # the guards of the reference are for it
            kp, kd = self.rig.gains(joint)
            on = motor.kp > 0
            return replace(motor, dq=0.0, tau=0.0, kp=self.part * kp * on, kd=self.part * kd * on)

        return self.replaced(motors, served)


for _name, _part in (("servo-soft", 0.6), ("servo-as-client", 1.0), ("servo-hard", 4.0)):
    add(
        "servo",
        _PositionServo,
        _name,
        f"is a position servo of {_part:g} times the client's stiffness",
        part=_part,
        control_law=True,
        warned=_SERVO | _FORCE_OF_ITS_OWN,
    )


class _Approach(What):
    """Moves to q by its own speed, and stops exactly at an object, with a force of its own."""

    force, top, approach = 0.5, 1.4, 30.0

    def __init__(self, rig: Faulty, side: Side, joints: tuple[int, ...]) -> None:
        super().__init__(rig, side, joints)
        rig.hand_of(side).step = self._step

    def _step(self, dt: float) -> None:
        hand = self.rig.hand_of(self.side)
        hand.now += dt
        hand.dq = hand.tau = 0.0
        if hand.braking or not hand.goal.kp:
            return
        top = self.top * hand.stroke
        hand.dq = min(max(self.approach * (hand.goal.q - hand.q), -top), top)
        floor = -math.inf if hand.touch is None else hand.touch
        if hand.q >= floor > hand.q + hand.dq * dt:
            hand.q, hand.dq, hand.tau = floor, 0.0, -self.force
        hand.q += hand.dq * dt


add(
    "servo",
    _Approach,
    "servo-of-speed",
    "moves by its own speed, and stops exactly at an object",
    one_joint=True,
    warned=_SERVO | {"DEX1-FORCE-09"},
)

# ------------------------------------------------------------------------------ what is measured


class _Lacks(What):
    """Leaves members of a state at 0."""

    members: tuple[str, ...] = ()

    def report(self, joint: int, values: Report) -> None:
        for member in self.members:
            setattr(values, member, 0)


add(
    "velocity",
    _Lacks,
    "no-velocity",
    "measures no velocity",
    members=("dq", "ddq"),
    needs="dq",
    lacks={"velocity", "acceleration"},
)
add(
    "force",
    _Lacks,
    "no-force",
    "measures no force",
    members=("tau",),
    needs="tau_est",
    lacks={"force"},
    warned={"DEX1-FORCE-01", "BRAINCO-FORCE-01", "FTP-FORCE-01"}
    | {f"DEX{n}-FORCE-{m}" for n in (3, 5) for m in ("01", "05")},
)
add(
    "mode",
    _Lacks,
    "no-mode",
    "reports no mode",
    members=("mode",),
    control_law=True,
    warned={"DEX3-MODE-01", "DEX5-MODE-03"},
)


class _Counts(What):
    """Reports torque in a unit of its own."""

    times, offset = 60_000.0, 0.0

    def report(self, joint: int, values: Report) -> None:
        values.tau = self.times * values.tau + self.offset


add(
    "force",
    _Counts,
    "torque-in-counts",
    "reports torque in counts",
    needs="tau_est",
    several=True,
    control_law=True,
    warned={f"DEX{n}-FORCE-{m}" for n in (3, 5) for m in ("02", "05")},
)
add(
    "force",
    _Counts,
    "force-offset",
    "shows a third of its force at rest, as if its sensors were not calibrated",
    times=1.0,
    offset=-0.33,
    needs="tau_est",
    position_servo=True,
    not_of={"brainco-revo2"},
    warned={"FTP-FORCE-04"},
)


class _Without(What):
    """Has other constants of its service."""

    values: Mapping[str, Any] = {}

    def __init__(self, rig: Faulty, side: Side, joints: tuple[int, ...]) -> None:
        super().__init__(rig, side, joints)
        for name, value in self.values.items():
            setattr(rig, name, value)


add(
    "sensors",
    _Without,
    "no-arrays",
    "has no tactile sensors",
    values={"sensors": 0},
    has="sensors",
    lacks={"pressure"},
)
add(
    "sensors",
    _Without,
    "no-imu",
    "has no IMU",
    values={"attitude": (0.0, 0.0, 0.0, 0.0)},
    has="sensors",
    lacks={"imu"},
)
add(
    "sensors",
    _Without,
    "bare",
    "has neither tactile sensors nor an IMU",
    values={"sensors": 0, "attitude": (0.0, 0.0, 0.0, 0.0)},
    has="sensors",
    lacks={"pressure", "imu"},
)
add(
    "low-rate",
    _Without,
    "no-low-rate",
    "has no second topic",
    values={"low_due": math.inf},
    has="low_period",
    lacks={"low_rate"},
    warned={"DEX3-TOPIC-03"},
)

# ------------------------------------------------------------------------------------- timing

for _rate, _tick, _period in ((200, 0.0025, 0.005), (250, 0.002, 0.004), (1000, 0.001, 0.001)):
    add(
        "rate",
        _Without,
        f"rate-{_rate}",
        f"publishes {_rate} times a second",
        values={"tick": _tick, "period": _period},
        control_law=True,
        warned={f"DEX{n}-RATE-01" for n in (1, 3, 5)},
    )
for _rate, _tick, _period in ((44, 0.0025, 0.0225), (100, 0.0025, 0.01)):
    add(
        "rate",
        _Without,
        f"rate-{_rate}",
        f"publishes {_rate} times a second",
        values={"tick": _tick, "period": _period},
        position_servo=True,
        not_of={"brainco-revo2"} if _rate < 100 else frozenset(),
        warned={"BRAINCO-RATE-01", "DFX-RATE-01", "FTP-RATE-01"},
    )
add("resolution", Counts, "counts-512", "measures q in 512 steps of a turn", per_turn=512)


class _Line(What):
    """Measures each 0.13 s and obeys 0.2 s late, as the Inspire hands of a real G1."""

    measures, late = 0.13, 0.2

    def __init__(self, rig: Faulty, side: Side, joints: tuple[int, ...]) -> None:
        super().__init__(rig, side, joints)
        self.waiting: deque[tuple[float, Motors]] = deque()

    def command(self, motors: Motors) -> Motors | None:
        self.waiting.append((self.rig.now + self.late, motors))
        return None

    def tick(self, dt: float, active: bool) -> None:
        while self.waiting and self.waiting[0][0] <= self.rig.now:
            self.rig.hand_of(self.side).command(self.waiting.popleft()[1])

    def report(self, joint: int, values: Report) -> None:
        at, q = self.memory.get(joint, (-math.inf, 0.0))
        if self.rig.now - at >= self.measures:
            at, q = self.memory[joint] = self.rig.now, values.q
        values.q = q


add(
    "latency",
    _Line,
    "slow-line",
    "measures each 0.13 s and obeys 0.2 s late",
    position_servo=True,
    not_of={"brainco-revo2"},
)

# ------------------------------------------------------------------------- one side, and claims


class _Alone(What):
    """Is served on one side alone."""


add("sides", _Alone, "left-alone", "is served on the left alone", served=(Side.LEFT,))
add("sides", _Alone, "right-alone", "is served on the right alone", served=(Side.RIGHT,))
add("sides", _Alone, "pair", "is served on both sides", served=tuple(Side))


class _Claims(What):
    """Its maker says which units it has."""


add("claims", _Claims, "claims", "has claims of all units that it has", claims=True)
add("claims", _Claims, "claims-nothing", "has a file of claims that claims no unit", claims=False)

DEVIATIONS: Mapping[str, type[What]] = FOUND
"""Every deviation, by name."""
GROUPS: Mapping[str, list[str]] = FOUND_GROUPS
"""The names of the deviations of which a hand has one at most."""
