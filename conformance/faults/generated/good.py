"""Permitted deviations of generated good hands, which no client notices.

Each stays within what the sources allow (docs/sources/unitree-dex.md#b2, #b4 of the same page): a
vendor may measure more coarsely, have more friction, answer some milliseconds later, brake in
another way. One of each group can be in a hand; a hand with two slow gears is no good one. What a
reference does not measure has no noise either: the deviation ``needs`` it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from dexkit.conformance.faults.generated.rig import Faulty, Motors, Report, What
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.virtual import Sample
from dexkit.hand import Side

__all__ = ["FOUND", "FOUND_GROUPS", "Backlash", "Counts", "Mechanics", "SoftStart", "add"]

W = TypeVar("W", bound=type[What])
_ONE = {"one_joint": True}
FOUND: dict[str, type[What]] = {}
FOUND_GROUPS: dict[str, list[str]] = {}


def add(group: str, base: type[What], title: str, summary: str, **values: object) -> None:
    """Make a deviation.

    :param group: a hand has one of each.
    :param base: what it does.
    :param values: attributes of its class.
    """
    made: type[What] = type(base.__name__, (base,), {"good": True, "kind": "good", **values})
    made.title, made.summary = title, summary
    FOUND[title] = made
    FOUND_GROUPS.setdefault(group, []).append(title)


# ----------------------------------------------------------------------------- measurement


class _Noise(What):
    q = dq = tau = 0.0

    def report(self, joint: int, values: Report) -> None:
        span = self.rig.spans[self.side][joint]
        values.q += self.random.gauss(0.0, self.q * span) if self.q else 0.0
        values.dq += self.random.gauss(0.0, self.dq * span) if self.dq else 0.0
        if self.tau:
            values.tau += self.random.gauss(0.0, self.tau * self.rig.strength(self.side, joint))


add("noise", _Noise, "noise-q-small", "has noise of 0.02 % of the range on q", q=2e-4)
add("noise", _Noise, "noise-q", "has noise of 0.06 % of the range on q", q=6e-4)


class _WideNoise(What):
    """Every value within a part of the range is as likely."""

    part = 0.007

    def report(self, joint: int, values: Report) -> None:
        span = self.rig.spans[self.side][joint]
        values.q += self.random.uniform(-self.part, self.part) * span


add("noise", _WideNoise, "noise-q-wide", "has noise of up to 0.7 % of the range on q", **_ONE)
add(
    "noise",
    _Noise,
    "noise-dq",
    "has noise of 1 % of the range in a second on dq",
    dq=0.01,
    needs="dq",
)
add(
    "noise",
    _Noise,
    "noise-tau",
    "has noise of 3 % of a soft grip on tau_est",
    tau=0.03,
    needs="tau_est",
)


class Counts(What):
    """Measures q in steps of an encoder."""

    per_turn = 4096

    def report(self, joint: int, values: Report) -> None:
        step = 2 * math.pi / self.per_turn
        values.q = step * round(values.q / step)


add("resolution", Counts, "counts-4096", "measures q in 4096 steps of a turn", per_turn=4096)
add("resolution", Counts, "counts-16384", "measures q in 16384 steps of a turn", per_turn=16384)


class _Predicted(What):
    """Measures 100 times a second and extrapolates by its velocity in between.

    The velocity is the joint's own, in q's unit: dq of a state may be in another, or not be there.
    """

    period = 0.01

    def report(self, joint: int, values: Report) -> None:
        now = self.rig.now
        at, q, dq, speed = self.memory.get(joint, (-math.inf, 0.0, 0.0, 0.0))
        if now - at >= self.period - 0.5 * self.rig.tick:
            at, q, dq = now, values.q, values.dq
            speed = self.rig.velocities(self.side)[joint]
            self.memory[joint] = at, q, dq, speed
        values.q, values.dq = q + speed * (now - at), dq


add("prediction", _Predicted, "predicts-100", "measures 100 times a second, and predicts")
add("prediction", _Predicted, "predicts-150", "measures 150 times a second", period=1 / 150)


class Backlash(What):
    """Its sensor is behind a gear with play."""

    play = 0.002

    def report(self, joint: int, values: Report) -> None:
        half = 0.5 * self.play * self.rig.spans[self.side][joint]
        q = self.memory.get(joint, values.q)
        self.memory[joint] = values.q = min(max(q, values.q - half), values.q + half)


add("backlash", Backlash, "backlash", "has play of 0.2 % of the range before its sensor")
add("backlash", Backlash, "backlash-more", "has play of 0.5 % of the range", play=0.005)


# ------------------------------------------------------------------------------- mechanics


class Mechanics(What):
    """Has other constants of its mechanics."""

    factors: Mapping[str, float] = {}
    done = False

    def tick(self, dt: float, active: bool) -> None:
        if not self.done:
            self.done = True
            hand = self.rig.hand_of(self.side)
            for name, factor in self.factors.items():
                setattr(hand, name, factor * getattr(hand, name))


add("mechanics", Mechanics, "heavier", "has 1.5 times the inertia", factors={"inertia": 1.5})
add("mechanics", Mechanics, "heavier-more", "has twice the inertia", factors={"inertia": 2.0})
add("mechanics", Mechanics, "lighter", "has half of the inertia", factors={"inertia": 0.5})
add("mechanics", Mechanics, "slower", "has 1.15 times the friction", factors={"viscous": 1.15})
add("mechanics", Mechanics, "faster", "has 0.8 times the friction", factors={"viscous": 0.8})
add("mechanics", Mechanics, "sticky", "has 1.5 times the dry friction", factors={"coulomb": 1.5})
add(
    "mechanics",
    Mechanics,
    "stronger",
    "has five times the largest torque, and the inertia of such a motor",
    factors={"tau_max": 5.0, "inertia": 3.0},
    **_ONE,
)
add("mechanics", Mechanics, "soft-stops", "has stops half as stiff", factors={"stiffness": 0.5})


class _WarmsUp(What):
    """Has twice the dry friction at first, which falls within 20 s of motion."""

    own: float | None = None

    def tick(self, dt: float, active: bool) -> None:
        hand = self.rig.hand_of(self.side)
        if self.own is None:
            self.own = hand.coulomb
        hand.coulomb = self.own * (1.0 + max(0.0, 1.0 - self.rig.tracks[self.side].moved / 20.0))


add("mechanics", _WarmsUp, "warms-up", "has twice the dry friction until it is warm")


class _Weight(What):
    """A constant weight pulls at the joint."""

    part = 0.05

    def torque(self, joint: int, tau: float, dt: float) -> float:
        if not self.rig.driven(self.side):
            return tau  # a hand at rest is balanced: its gear holds it
        return tau + self.part * self.rig.strength(self.side, joint)


add("weight", _Weight, "sags-up", "is pulled open by a weight", part=0.05)
add("weight", _Weight, "sags-down", "is pulled closed by a weight", part=-0.05)


class SoftStart(What):
    """Raises the torque within 0.15 s when it begins to be driven."""

    seconds = 0.15
    since: float | None
    driven_at: float | None = None

    def torque(self, joint: int, tau: float, dt: float) -> float:
        if not self.rig.driven(self.side):
            self.driven_at = None
            return tau
        if self.driven_at is None:
            self.driven_at = self.rig.now
        return tau * min(1.0, 0.1 + (self.rig.now - self.driven_at) / self.seconds)


add("start", SoftStart, "soft-start", "raises its torque within 0.15 s when it is driven")


class _TopSpeed(What):
    """Moves at no more than a speed, as a servo with a profile velocity does."""

    rads = 4.0

    def torque(self, joint: int, tau: float, dt: float) -> float:
        hand = self.rig.hand_of(self.side)
        if not self.rig.driven(self.side):
            return tau
        drag, dry, dq = float(hand.viscous), float(hand.coulomb), float(hand.dq)
        high = drag * self.rads + dry + 0.3 * (self.rads - dq)
        low = -drag * self.rads - dry - 0.3 * (self.rads + dq)
        return min(max(tau, low), high)


add("speed", _TopSpeed, "top-speed-4.5", "moves at 4.5 rad/s at most", rads=4.5, **_ONE)
add("speed", _TopSpeed, "top-speed-3.6", "moves at 3.6 rad/s at most", rads=3.6, **_ONE)


class _Servo(What):
    """A position servo: follows q with its own stiffness whenever kp is not 0."""

    times = 4.0

    def command(self, motors: Motors) -> Motors | None:
        def stiff(joint: int, motor: Motor) -> Motor:
            values = (motor.q, motor.dq, motor.tau, motor.kp, motor.kd)
            if not all(map(math.isfinite, values)) or motor.kp <= 0 or motor.kd < 0:
                return motor  # the guards of the reference are for it
            kp, kd = self.rig.gains(joint)
            return replace(motor, kp=self.times * kp, kd=max(motor.kd, self.times * kd))

        return self.replaced(motors, stiff)


add("servo", _Servo, "servo-stiff", "is a position servo of four times the stiffness", **_ONE)
add("servo", _Servo, "servo-own", "is a position servo of its own stiffness", times=1.5, **_ONE)


# ---------------------------------------------------------------------------------- timing


class _Latency(What):
    seconds = 0.02
    turn = 1  # what the others have made of a command is late

    def __init__(self, rig: Faulty, side: Side, joints: tuple[int, ...]) -> None:
        super().__init__(rig, side, joints)
        self.queue: deque[tuple[float, Motors]] = deque()

    def command(self, motors: Motors) -> Motors | None:
        self.queue.append((self.rig.now, motors))
        return None

    def tick(self, dt: float, active: bool) -> None:
        if self.rig.ended:
            self.queue.clear()
        while self.queue and self.queue[0][0] <= self.rig.now - self.seconds:
            _, motors = self.queue.popleft()
            hand = self.rig.hand_of(self.side)
            if self.rig.codec.joints > 1:
                hand.command(motors)
            else:
                self.rig.command(self.side, motors[0])  # type: ignore[attr-defined]


for _ms in (5, 10, 20):
    add(
        "latency",
        _Latency,
        f"latency-{_ms}",
        f"obeys each command {_ms} ms late",
        seconds=_ms / 1000,
    )


class _Published(What):
    """Changes when states are published: once, also where one message holds both sides."""

    def publish(self, samples: list[Sample]) -> list[Sample]:
        if self.rig.codec.shared and self.side is not self.rig.sides[0]:
            return samples
        return self.timed(samples)

    def timed(self, samples: list[Sample]) -> list[Sample]:
        """The samples that are published instead of these."""
        raise AssertionError  # overridden


class _StateLatency(_Published):
    seconds = 0.01
    turn = -1  # the others act when a state leaves

    def __init__(self, rig: Faulty, side: Side, joints: tuple[int, ...]) -> None:
        super().__init__(rig, side, joints)
        self.queue: deque[Sample] = deque()

    def timed(self, samples: list[Sample]) -> list[Sample]:
        if self.rig.ended:
            # an older one would leave together with the state before the last
            return [x for x in samples if x.sent == self.rig.now]
        self.queue.extend(samples)
        out = []
        while self.queue and self.queue[0].sent <= self.rig.now - self.seconds + 1e-9:
            out.append(replace(self.queue.popleft(), sent=self.rig.now))
        return out


# with a late command they make more than the 20 ms that a round may take
add("latency", _StateLatency, "state-late-6", "publishes 6 ms after it measured", seconds=0.006)
add("latency", _StateLatency, "state-late-10", "publishes 10 ms after it measured", seconds=0.01)


class _Jitters(_Published):
    """Holds some states back until the next one."""

    part = 0.05

    def timed(self, samples: list[Sample]) -> list[Sample]:
        out = [*self.memory.pop("held", []), *samples]
        if len(out) == 1 and not self.rig.ended and self.random.random() < self.part:
            self.memory["held"] = out
            return []
        return out


class _Pauses(_Published):
    """Publishes nothing for 72 ms in every 2.5 s."""

    def timed(self, samples: list[Sample]) -> list[Sample]:
        quiet = self.rig.now > 1.0 and self.rig.now % 2.5 < 0.072 and not self.rig.ended
        return [] if quiet else samples


add("state", _Pauses, "pauses", "has a gap of 75 ms in every 2.5 s: a log is written")
add("state", _Jitters, "jitter-2", "publishes 2 % of its states a period late", part=0.02)
add("state", _Jitters, "jitter-5", "publishes 5 % of its states a period late", part=0.05)


# --------------------------------------------------------------------------------- braking


class _Coasts(What):
    """Opens its windings when it brakes: only friction slows it."""

    def tick(self, dt: float, active: bool) -> None:
        hand = self.rig.hand_of(self.side)
        if hand.brake:
            hand.brake = 0.0
            if self.rig.codec.joints > 1:
                hand.changed()


# a status of 0 locks a hand of several joints (DEX3-MODE-03): coasting is a fault there
add("brake", _Coasts, "brake-coast", "coasts when it brakes", **_ONE)


class _Holds(What):
    """Holds the position that it has when the commands have stopped, as a servo does."""

    def torque(self, joint: int, tau: float, dt: float) -> float:
        if self.rig.driven(self.side) or not self.rig.tracks[self.side].commands:
            self.memory.pop(joint, None)
            return tau
        q = self.rig.positions(self.side)[joint]
        kp, kd = self.rig.gains(joint)
        dq = self.rig.velocities(self.side)[joint]
        at: float = self.memory.setdefault(joint, q)
        return kp * (at - q) - kd * dq


add("brake", _Holds, "brake-hold", "holds its position when it brakes")


class _Releases(What):
    """Lets its torque go within 0.3 s when it brakes: that may stop a joint, but not turn it."""

    seconds = 0.3

    def __init__(self, rig: Faulty, side: Side, joints: tuple[int, ...]) -> None:
        super().__init__(rig, side, joints)
        self.last: dict[int, float] = {}
        self.dq: dict[int, float] = {}
        """Velocity of each joint when it began to brake, rad/s."""
        self.since_brake: float | None = None

    def torque(self, joint: int, tau: float, dt: float) -> float:
        if self.rig.driven(self.side):
            self.since_brake = None
            # all of it: tau is without the law's damping in a hand of several joints
            self.last[joint] = self.rig.seen(self.side)[2][joint]
            self.dq[joint] = self.rig.velocities(self.side)[joint]
            return tau
        if self.since_brake is None:
            self.since_brake = self.rig.now
        before, now = self.dq.get(joint, 0.0), self.rig.velocities(self.side)[joint]
        if before * self.last.get(joint, 0.0) < 0.0 and before * now <= 0.0:
            self.last[joint] = 0.0
        left = 1.0 - (self.rig.now - self.since_brake) / self.seconds
        return tau + self.last.get(joint, 0.0) * max(0.0, left)


add("brake", _Releases, "brake-release", "lets its torque go within 0.3 s when it brakes")
add("brake", _Releases, "brake-release-fast", "lets its torque go within 0.1 s", seconds=0.1)


class _StrongBrake(Mechanics):
    factors: Mapping[str, float] = {"brake": 3.0}


add("brake", _StrongBrake, "brake-short", "brakes three times as hard")


class _Relaxes(What):
    """Stops pressing when commands end, and holds where it is then."""

    position_servo = True
    done = False

    def tick(self, dt: float, active: bool) -> None:
        hand = self.rig.hand_of(self.side)
        silent = math.isinf(hand.heard)
        if silent and not self.done and self.rig.driven(self.side):
            hand.place = list(hand.q)
            hand.goal = np.array(hand.place)
            hand.changed()
        self.done = silent


add("brake", _Relaxes, "brake-relax", "stops pressing when commands end, and holds")
