"""Moves the joints of a hand, and stores commands and measurements.

A generator yields each command and is sent the state that the exchange of this command returned.
Time is the states' stamps. A joint is never commanded further than :attr:`Setup.lead` from where it
is, so its motor gives at most kp times that, however far its goal is; and a damping term never adds
more. The goal of a position servo, which limits its force itself, is not held back.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

import numpy as np

from dexkit.hand import Floats, HandCommand, HandSpec, HandState, JointMode
from dexkit.models import Dialect, model
from dexkit.teleop.client import LEAD

__all__ = ["LEAD", "SETTLE", "Bench", "Moved", "Series", "Setup", "Turns"]

T = TypeVar("T")
Turns: TypeAlias = Generator[HandCommand, HandState, T]

_HOLD = 0.02
"""Seconds by which a way goes on at most a turn: a pause does not make a jump."""
_STALL = 0.6
"""Seconds without progress after which a joint counts as blocked."""
_PROGRESS = 0.004
"""Part of the stroke that is progress."""
_AGAINST = 0.05
"""Part of the stroke by which a joint may move against its command before it is left alone."""
_ARRIVED = 0.01
"""Part of the stroke from its goal within which a position servo has arrived."""
SETTLE = 0.15
"""Seconds over which a joint is looked at whether it is at rest."""
_SETTLE_MOST = 2.0
_STILL = 2e-4
"""Part of the stroke by which a joint at rest may move meanwhile, its noise apart."""
_PATIENCE = 6
"""Attempts at a measurement that a pause of this machine spoils."""


@dataclass(frozen=True)
class Setup:
    """Properties of a hand that are known before the test.

    :param kp: per joint; ``kd`` likewise: those of the model's client.
    :param full: speed of each joint toward smaller and larger q, shape (n, 2).
    :param servo: each motor goes to q by itself, with at most the speed dq.
    :param period: seconds from exchange to exchange that were aimed at.
    :param lead: most that q of a command may be ahead of the hand.
    """

    spec: HandSpec
    dialect: Dialect
    kp: Floats
    kd: Floats
    full: Floats
    servo: bool
    period: float
    lead: float = LEAD

    @classmethod
    def from_spec(
        cls,
        spec: HandSpec,
        *,
        dialect: Dialect | None = None,
        joint_speeds: tuple[tuple[float, float], ...] | None = None,
        rate: float = 200.0,
        lead: float = LEAD,
    ) -> Setup:
        """The setup of a hand.

        :param dialect: by which it is commanded; None for the model's first.
        :param joint_speeds: of each joint toward larger and smaller q, as calibrated hands have.
        :param rate: exchanges a second, if the hand allows as many.
        """
        profile = model(spec.model)
        spoken = dialect or profile.dialects[0]
        if joint_speeds is None:
            full = np.array([(j.dq_max, j.dq_max) for j in spec.joints])
        else:
            full = np.array([(down, up) for up, down in joint_speeds])
        kp, kd = np.array(profile.gains).T
        return cls(
            spec=spec,
            dialect=spoken,
            kp=kp,
            kd=kd,
            full=full,
            servo=spoken.position_servo,
            period=1.0 / min(rate, spec.io_rate),
            lead=lead,
        )

    @property
    def stroke(self) -> Floats:
        """Width of each joint's range, shape (n,)."""
        return self.spec.q_max - self.spec.q_min


@dataclass(frozen=True, eq=False)
class Series:
    """Samples of one joint: seconds, commanded and measured q; shape (n,)."""

    t: Floats
    command: Floats
    q: Floats

    def gap(self, begin: float = -math.inf, end: float = math.inf) -> float:
        """Seconds between two samples at most, from a time to a time."""
        times = self.t[(self.t >= begin) & (self.t <= end)]
        return float(np.diff(times).max()) if len(times) > 1 else 0.0


@dataclass(frozen=True)
class Moved:
    """Result of a motion.

    :param arrived: it reached its goal, as far as the command goes.
    :param against: it moved against its command.
    """

    arrived: bool
    against: bool = False


@dataclass(eq=False)
class Bench:
    """A hand under test.

    :ivar x: q that each joint is to go to, shape (n,).
    :ivar limp: joints that are not driven any more.
    :ivar noise: of q at rest, standard deviation, shape (n,).
    :ivar spoiled: measurements that pauses of this machine spoiled for good.
    """

    setup: Setup
    limp: set[int] = field(default_factory=set)
    spoiled: int = 0
    t: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.x: Floats = np.full(self.setup.spec.n_joints, math.nan)
        self.noise: Floats = np.zeros(self.setup.spec.n_joints)
        self.state: HandState | None = None
        self._rows: list[tuple[Floats, Floats]] = []

    # -- what is sent ----------------------------------------------------------------------------

    def rest(self) -> HandCommand:
        """Brake every joint."""
        return HandCommand.brake(self.setup.spec.n_joints)

    def hold(self) -> HandCommand:
        """Stay where it is, with the client's gains."""
        assert self.state is not None
        self.x = self.state.q.copy()
        return self._command(self.x, np.zeros(len(self.x)))

    def _command(self, x: Floats, dq: Floats) -> HandCommand:
        s = self.setup
        assert self.state is not None
        q, speed = x.copy(), self.slow if s.servo and not dq.any() else dq
        if not s.servo:
            now, there = np.nan_to_num(self.state.dq), self.there
            q = np.clip(x, there - s.lead, there + s.lead)
            room = (s.kp * s.lead - np.abs(s.kp * (q - there))) / np.maximum(s.kd, 1e-9)
            speed = np.where(dq != 0, np.clip(dq, now - room, now + room), 0.0)
        kp, kd = s.kp.copy(), s.kd.copy()
        mode = np.full(len(q), JointMode.FOC, dtype=np.uint8)
        for j in self.limp:
            q[j], speed[j], kp[j], kd[j], mode[j] = self.state.q[j], 0.0, 0.0, 0.0, JointMode.BRAKE
        return HandCommand(q=q, dq=speed, tau=np.zeros(len(q)), kp=kp, kd=kd, mode=mode)

    @property
    def there(self) -> Floats:
        """Expected position when a command reaches the hand: one period after its last state."""
        assert self.state is not None
        if len(self.t) < 2 or self.t[-1] - self.t[-2] > 4 * self.setup.period:
            return self.state.q
        speed = (self._rows[-1][1] - self._rows[-2][1]) / (self.t[-1] - self.t[-2])
        return np.asarray(self.state.q + speed * self.setup.period)

    @property
    def slow(self) -> Floats:
        """Speed of slow ways: a third of the stroke a second, at most a quarter of the most."""
        slow: Floats = np.minimum(self.setup.stroke / 3, self.setup.full.min(axis=1) / 4)
        return slow

    # -- turns -----------------------------------------------------------------------------------

    def turn(self, dq: Floats | None = None) -> Turns[float]:
        """One exchange of :attr:`x`; the seconds since the last one, held after a pause.

        :param dq: velocity feed-forward, or the speed of a position servo; None for none.
        """
        command = self._command(self.x, np.zeros(len(self.x)) if dq is None else dq)
        return (yield from self._exchange(command, command.q))

    def _exchange(self, command: HandCommand, q: Floats) -> Turns[float]:
        state = yield command
        before = self.state.stamp if self.state is not None else state.stamp
        if self.state is None or state.stamp > before:
            self.t.append(state.stamp)
            self._rows.append((q, state.q))
        self.state = state
        return min(max(state.stamp - before, 0.0), _HOLD)

    def watch(self, seconds: float) -> Turns[list[HandState]]:
        """Leave the hand at rest for so long, and return the states."""
        seen: list[HandState] = []
        end = math.inf
        nothing = np.full(len(self.x), math.nan)
        while not seen or seen[-1].stamp < end:
            yield from self._exchange(self.rest(), nothing)
            assert self.state is not None
            seen.append(self.state)
            end = seen[0].stamp + seconds
        self.x = self.state.q.copy() if self.state is not None else self.x
        return seen

    def stays(self, joint: int, most: float) -> Turns[bool]:
        """Tell a joint to stay where it is; False as soon as it has moved by more than ``most``."""
        assert self.state is not None
        begin = self.x[joint] = float(self.state.q[joint])
        end = self.state.stamp + SETTLE
        while self.state.stamp < end:
            yield from self.turn()
            if abs(float(self.state.q[joint]) - begin) > most:
                return False
        return True

    def settle(self, joint: int) -> Turns[None]:
        """Stay commanded until a joint has come to rest, or does not."""
        assert self.state is not None
        begin = self.state.stamp
        still = max(_STILL * float(self.setup.stroke[joint]), 4 * float(self.noise[joint]))
        while self.state.stamp < begin + _SETTLE_MOST:
            yield from self.wait(SETTLE)
            after = self.t[-1] - SETTLE
            q = self._recent(joint, after)
            # a pause of this machine leaves too few samples to tell
            enough = len(q) >= SETTLE / self.setup.period / 3
            if enough and max(q) - min(q) <= still:
                return

    def _recent(self, joint: int, after: float) -> list[float]:
        """Q of a joint since a time."""
        begin = bisect_left(self.t, after)
        return [float(row[1][joint]) for row in self._rows[begin:]]

    def wait(self, seconds: float) -> Turns[None]:
        """Stay commanded for so long."""
        assert self.state is not None
        end = self.state.stamp + seconds
        while self.state.stamp < end:
            yield from self.turn()

    def move(
        self, joint: int, goal: float, speed: float, *, fast: bool = False, settle: bool = False
    ) -> Turns[Moved]:
        """Lead a joint to a goal.

        :param speed: of the command, unit of q a second.
        :param fast: with velocity feed-forward, and slower at either end of the way.
        :param settle: wait there until it is at rest.
        """
        s = self.setup
        assert self.state is not None
        begin = float(self.state.q[joint])
        if s.servo or not math.isfinite(self.x[joint]):
            self.x[joint] = begin
        at = float(self.x[joint])
        direction = 1 if goal >= at else -1
        length = max(abs(goal - at), 1e-12)
        stroke = float(s.stroke[joint])
        best, progressed = begin, self.state.stamp
        dt = s.period
        while True:
            q = float(self.state.q[joint])
            if direction * (q - best) > _PROGRESS * stroke:
                best, progressed = q, self.state.stamp
            if direction * (q - begin) < -_AGAINST * stroke:
                self.x[joint] = q
                return Moved(arrived=False, against=True)
            pace = speed
            if fast and not s.servo:
                done = abs(at - (goal - direction * length)) / length
                pace = speed * min(1.0, math.sqrt(max(0.02, min(done, 1.0 - done) / 0.2)))
            if s.servo:
                at = goal
                arrived = abs(q - goal) <= _ARRIVED * stroke
            else:
                at += direction * min(pace * dt, max(direction * (goal - at), 0.0))
                # a joint that lags holds its command back
                there = float(self.there[joint])
                at = min(max(at, there - s.lead), there + s.lead)
                arrived = direction * (goal - at) <= 1e-9
            self.x[joint] = at
            held = s.servo or abs(at - q) >= 0.9 * s.lead  # else the command is still on its way
            blocked = held and self.state.stamp - progressed > _STALL + _PROGRESS * stroke / speed
            if arrived or blocked:
                if settle:
                    yield from self.settle(joint)
                return Moved(arrived=arrived)
            dq = np.zeros(len(self.x))
            if fast or s.servo:
                dq[joint] = pace if s.servo else direction * pace
            dt = yield from self.turn(dq)

    # -- what was measured -----------------------------------------------------------------------

    def forget(self) -> None:
        """Drop the samples so far, and with them every mark: a long test need not keep them all."""
        del self.t[:-2], self._rows[:-2]

    @property
    def mark(self) -> int:
        """A place in the samples: now."""
        return len(self.t)

    def series(self, joint: int, begin: int, end: int | None = None) -> Series:
        """The samples of a joint between two places."""
        rows = self._rows[begin:end]
        table = np.array([[c[joint], q[joint]] for c, q in rows]).reshape(len(rows), 2)
        return Series(np.array(self.t[begin:end]), table[:, 0], table[:, 1])

    def moved(self, begin: int) -> Floats:
        """Displacement of each joint since a given position, shape (n,)."""
        if begin >= len(self._rows):
            return np.zeros(len(self.x))
        return np.asarray(self._rows[-1][1] - self._rows[begin][1])

    def undisturbed(self, attempt: Callable[[], Turns[T | None]]) -> Turns[T | None]:
        """Repeat a measurement that returns None until it returns something; None if it never does.

        It returns None when a pause of this machine falls into it (:meth:`Series.gap`).
        """
        for _ in range(_PATIENCE):
            found = yield from attempt()
            if found is not None:
                return found
        self.spoiled += 1
        return None
