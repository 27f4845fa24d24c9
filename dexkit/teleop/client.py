"""Unitree's teleoperation clients, sans-IO: states and the operator's input in, commands out.

What xr_teleoperate does to a hand between the hand tracking and the topics, with all of its
quirks (docs/sources/unitree-dex.md#b1 and docs/sources/unitree-dex.md#b7; read in its
``robot_hand_unitree.py`` and ``weighted_moving_filter.py``, releases 1.1, 1.4 and the newest one
listed there; that of the Dex5-1 in a pull request that was open then):

- States are received by one thread that reads left, then right, each time waiting for a sample
  that it has not had, and pauses for 2 ms: :class:`StateReceiver`. A side that falls silent stops
  the other one too.
- No command before a state of both sides; for a Dex3-1 or Dex5-1 (and a Dex1-1 before 1.4) not
  before some q is other than exactly 0.
- The Dex1-1's target is clipped to 0.18 rad of the last state and smoothed over three values, but
  a pair of values equal to the one before is not counted: :class:`StickyFilter`.
- Before any input the Dex1-1 goes to mid stroke, the others to 0.

The caller steps a client :attr:`TeleopClient.rate` times a second. The genuine ones sleep the rest
of each period, so they come out some 2 % below it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple, TypeAlias

from dexkit.errors import UsageError
from dexkit.hand import JointMode, Side
from dexkit.models import DEX1_1, Dialect, model

__all__ = [
    "LEAD",
    "PINCH_MAX",
    "PINCH_MIN",
    "POLL_PAUSE",
    "Dex1Client",
    "EitherHandClient",
    "FingerClient",
    "Inputs",
    "JointCommand",
    "Pose",
    "Release",
    "RightHandClient",
    "StateReceiver",
    "StickyFilter",
    "TeleopClient",
]

POLL_PAUSE = 0.002
"""Seconds that the receiving thread pauses after each pair of states
(docs/sources/unitree-dex.md#b1, "polls every >= 2 ms").
"""
LEAD = 0.18
"""Rad by which a Dex1-1 command may be ahead of the last state: 3 mm of jaw travel
(docs/sources/unitree-dex.md#b3)."""
LEAD_SIMULATED_1_1 = 1.0
"""The same in simulation, release 1.1; later ones do not clip there
(docs/sources/unitree-dex.md#b3)."""
WEIGHTS = (0.5, 0.3, 0.2)
"""Weights of the three last values, newest first (docs/sources/unitree-dex.md#b3)."""
PINCH_MIN, PINCH_MAX = 5.0, 7.0
"""Pinch distance or trigger that means closed, and open (docs/sources/unitree-dex.md#b3)."""

Pose: TypeAlias = tuple[float, ...]
"""q of every joint of a hand, rad."""
Inputs: TypeAlias = Mapping[Side, Pose | None]
"""Output of hand tracking: the pinch value of a Dex1-1, the joint targets of other hands; None, or
no entry, without data."""


class JointCommand(NamedTuple):
    """One motor's part of a command: mode byte, rad, rad/s, N m, N m/rad, N m s/rad."""

    mode: int
    q: float
    dq: float
    tau: float
    kp: float
    kd: float


class Release(str, Enum):
    """The release of xr_teleoperate that is modelled, where they differ for the Dex1-1.

    1.1 has both grippers in one message and waits for a q that is not exactly 0. 1.4 is what the
    shipped recordings were made with. The newest asks the tracker whether it has data, and holds
    the gripper where it is until then, instead of moving to mid stroke.
    """

    V1_1 = "1.1"
    V1_4 = "1.4"
    NEWEST = "newest"

    def __str__(self) -> str:
        return self.value


class StateReceiver:
    """The client's receiving thread: blocking reads one after the other, then a pause.

    Each reader keeps one sample. A pass that waits for one side holds what it has already read of
    the other; so after a silence of the right side the left one's value is an old one at first.

    :param reads: the sides that come with each read, in the order of the reads.
    :param pause: seconds between two passes.
    :ivar latest: state of each side after the last complete pass; empty before the first.
    """

    def __init__(self, reads: Sequence[tuple[Side, ...]], *, pause: float = POLL_PAUSE) -> None:
        self._reads = tuple(reads)
        self._pause = pause
        self._kept: dict[tuple[Side, ...], tuple[float, dict[Side, Pose]]] = {}
        self._seen: dict[Side, Pose] = {}
        self._held: dict[Side, Pose] = {}
        self._at = 0
        self._time = -math.inf
        self.latest: dict[Side, Pose] = {}

    @property
    def seen(self) -> Mapping[Side, Pose]:
        """The last state that came of each side, read or not."""
        return self._seen

    @property
    def wakes_at(self) -> float:
        """When the pause ends; a read waits from then on."""
        return self._time

    def forget(self) -> None:
        """Forget all states received."""
        self._kept, self._seen, self._held, self.latest = {}, {}, {}, {}
        self._at = 0

    def receive(self, now: float, states: Mapping[Side, Sequence[float]]) -> None:
        """Take a state message, of one side or of both.

        :param now: seconds on any monotonic clock; not before the last call.
        """
        self.advance(now)
        for sides in self._reads:
            if all(s in states for s in sides):
                poses = {s: tuple(states[s]) for s in sides}
                self._seen.update(poses)
                self._kept[sides] = (now, poses)
        self.advance(now)

    def advance(self, now: float) -> None:
        """Simulate the thread up to ``now``."""
        while self._time <= now:
            found = self._kept.pop(self._reads[self._at], None)
            if found is None:
                return
            came, states = found
            self._time = max(self._time, came)
            self._held.update(states)
            self._at += 1
            if self._at == len(self._reads):
                self.latest = dict(self._held)
                self._at = 0
                self._time += self._pause


class StickyFilter:
    """Weighted mean of the last three values; one equal to the last is not counted.

    So a value that no longer changes is never reached: the output stays a mixture of the last
    three different ones (docs/sources/unitree-dex.md#b7, "the smoothing filter sticks"). The values
    of both hands are one: while either changes, both are counted.
    """

    def __init__(self, weights: Sequence[float] = WEIGHTS) -> None:
        self._weights = tuple(reversed(weights))  # oldest first, as the values
        self.forget()

    def forget(self) -> None:
        """Forget all values put in."""
        self._recent: deque[Pose] = deque(maxlen=len(self._weights))
        self._output: Pose = ()

    def __call__(self, values: Pose) -> Pose:
        """Put values in, and take the smoothed ones."""
        if self._recent and all(a == b for a, b in zip(values, self._recent[-1], strict=True)):
            return self._output
        self._recent.append(values)
        if len(self._recent) < len(self._weights):
            self._output = values
        else:
            self._output = tuple(
                sum(w * x for w, x in zip(self._weights, column, strict=True))
                for column in zip(*self._recent, strict=True)
            )
        return self._output


class TeleopClient(ABC):
    """A client of one hand model.

    :param spoken: the dialect of the hands.
    :param sides: the hands that it drives. The genuine client always drives both, and waits for
        both; with one side it is what the same program would do if the other did not exist.
    :ivar rate: steps a second.
    """

    def __init__(self, spoken: Dialect, sides: Sequence[Side] = tuple(Side)) -> None:
        if not sides:
            raise UsageError("a client needs a side")
        spoken.check_sides(sides)
        self.dialect = spoken
        self.sides = tuple(s for s in (Side.LEFT, Side.RIGHT) if s in sides)
        self.rate = model(spoken.model).command_rate
        self._kp, self._kd = model(spoken.model).gains[0]
        shared = len({spoken.topics(s)[1] for s in self.sides}) < len(self.sides)
        self.receiver = StateReceiver([self.sides] if shared else [(s,) for s in self.sides])
        self._ready = False

    @property
    def period(self) -> float:
        """Seconds from step to step."""
        return 1.0 / self.rate

    @property
    def ready(self) -> bool:
        """Whether it has seen the states that it waits for, and sends commands."""
        if len(self.receiver.latest) < len(self.sides):
            return False
        if not self._ready:
            self._ready = self._may_start(self.receiver.latest)
        return self._ready

    @property
    def missing(self) -> dict[Side, str]:
        """The sides that it still waits for, and why; "" where no state came."""
        if self.ready:
            return {}
        latest = self.receiver.seen
        found = {s: "" for s in self.sides if s not in latest}
        if found:
            return found
        return {s: "every q is exactly 0" for s in self._awaited if not any(latest[s])}

    def begin_again(self) -> None:
        """Discard every state and the values derived from them; the operator's targets stay.

        For after a pause of the caller. The genuine client does not; it is restarted.
        """
        self.receiver.forget()

    def receive(self, now: float, states: Mapping[Side, Sequence[float]]) -> None:
        """Take a state message: q of the joints of the side, or sides, that are in it.

        :param now: seconds on any monotonic clock; not before the last call.
        """
        self.receiver.receive(now, states)

    def step(
        self, now: float, states: Mapping[Side, Sequence[float]], inputs: Inputs
    ) -> dict[Side, tuple[JointCommand, ...]]:
        """One turn of the control loop.

        :param states: what came just now and was not given to :meth:`receive`.
        :param inputs: what the operator wants.
        :returns: the command to each side; none before it is :attr:`ready`.
        """
        for side, q in states.items():
            self.receiver.receive(now, {side: q})
        self.receiver.advance(now)
        if not self.ready:
            return {}
        return self._control(self.receiver.latest, inputs)

    @property
    def _awaited(self) -> Sequence[Side]:
        """The sides whose q must not be all 0, where that is taken for no state."""
        return self.sides

    def _may_start(self, latest: Mapping[Side, Pose]) -> bool:
        return not self.dialect.zero_is_no_state or all(any(latest[s]) for s in self._awaited)

    def final_command(self, pose: Pose) -> tuple[JointCommand, ...]:
        """A command to hold the pose, with motors locked where the dialect has a mode for it."""
        hand = model(self.dialect.model)
        return tuple(
            JointCommand(
                self.dialect.mode(i, JointMode.BRAKE), q, hand.client_command.dq, 0.0, kp, kd
            )
            for i, (q, (kp, kd)) in enumerate(zip(pose, hand.gains, strict=True))
        )

    @abstractmethod
    def _control(
        self, latest: Mapping[Side, Pose], inputs: Inputs
    ) -> dict[Side, tuple[JointCommand, ...]]:
        """The commands of this turn."""


class Dex1Client(TeleopClient):
    """xr_teleoperate's ``Dex1_1_Gripper_Controller``; its input is a pinch value.

    In a dialect of another stroke (unitree_hg), which it does not speak, lead and stroke are
    scaled alike. If targets near an end go to the end there, its lead from such an end begins
    behind them, or it would never leave.

    :param release: which one; None takes 1.1 where both grippers share a message, 1.4 elsewhere.
    :param simulated: what it does with ``--sim``: no clipping and no smoothing (1.1: clipping to
        1 rad, smoothing as ever).
    """

    def __init__(
        self,
        spoken: Dialect | None = None,
        sides: Sequence[Side] = tuple(Side),
        *,
        release: Release | None = None,
        simulated: bool = False,
    ) -> None:
        spoken = spoken or DEX1_1.dialects[0]
        if not spoken.is_gripper:
            raise UsageError(f"the dialect {spoken.name} is not of a {DEX1_1.title}")
        super().__init__(spoken, sides)
        shared = spoken.length > 1
        self.release = release or (Release.V1_1 if shared else Release.V1_4)
        self._scale = spoken.q_open / DEX1_1.joints[Side.LEFT][0].q_max
        lead, smooth = LEAD, True
        if simulated and self.release is Release.V1_1:
            lead = LEAD_SIMULATED_1_1
        elif simulated:
            lead, smooth = math.inf, False
        self._lead = lead * self._scale
        self._filter = StickyFilter() if smooth else None
        self._targets = dict.fromkeys(self.sides, spoken.q_open / 2)

    def begin_again(self) -> None:
        """As in the base class; the values that are smoothed are states, too."""
        super().begin_again()
        if self._filter is not None:
            self._filter.forget()

    @property
    def targets(self) -> Mapping[Side, float]:
        """The target of each gripper, before clipping and filter, rad."""
        return self._targets

    def _may_start(self, latest: Mapping[Side, Pose]) -> bool:
        if self.release is Release.V1_1:
            return any(any(latest[s]) for s in self.sides)
        return True

    def target_of(self, pinch: float) -> float:
        """The target for a pinch value, rad."""
        part = (pinch - PINCH_MIN) / (PINCH_MAX - PINCH_MIN)
        return self.dialect.q_open * min(max(part, 0.0), 1.0)

    def _control(
        self, latest: Mapping[Side, Pose], inputs: Inputs
    ) -> dict[Side, tuple[JointCommand, ...]]:
        given = {s: inputs.get(s) for s in self.sides}
        if self.release is Release.NEWEST:
            tracked = all(value is not None for value in given.values())
            self._targets = {
                s: self.target_of(value[0]) if tracked and value else latest[s][0]
                for s, value in given.items()
            }
        else:
            # exactly 0 means no data, of both hands; with one alone the other is commanded to close
            pinches = {s: value[0] if value else 0.0 for s, value in given.items()}
            if any(pinch != 0.0 for pinch in pinches.values()):
                self._targets = {s: self.target_of(pinch) for s, pinch in pinches.items()}
        goals = []
        for s in self.sides:
            low, high = self._leads(latest[s][0])
            goals.append(min(max(self._targets[s], low), high))
        if self._filter is not None:
            goals = list(self._filter(tuple(goals)))
        return {
            s: (JointCommand(0, q, 0.0, 0.0, self._kp, self._kd),)
            for s, q in zip(self.sides, goals, strict=True)
        }

    def _leads(self, q: float) -> tuple[float, float]:
        """The lowest and highest goal for a gripper at ``q``, rad.

        The filter keeps up to half of where the gripper rested. So beside an end the goal is as
        far from the targets that go to the end as the end itself is, and a lead more.
        """
        closed, opened = self.dialect.ends
        low = q if q < opened else 2.0 * opened - self.dialect.q_open
        high = q if q > closed else 2.0 * closed
        return low - self._lead, high + self._lead


class FingerClient(TeleopClient):
    """The client of a hand of several joints; its input are the joint targets.

    The genuine ones get hand skeletons, and a retargeting library makes joint targets of them;
    that library is not modelled. States are only waited for: nothing is clipped or smoothed, and
    the hand hears no more of where it is. One more quirk cannot be had without a process that
    forks: the genuine clients' commands reach only readers that were there before them
    (docs/sources/unitree-dex.md#b7).
    """

    def __init__(self, spoken: Dialect, sides: Sequence[Side] = tuple(Side)) -> None:
        super().__init__(spoken, sides)
        hand = model(spoken.model)
        self._gains, self._dq = hand.gains, hand.client_command.dq
        self._targets = {s: tuple(j.straight for j in hand.joints[s]) for s in self.sides}

    def _control(
        self, latest: Mapping[Side, Pose], inputs: Inputs
    ) -> dict[Side, tuple[JointCommand, ...]]:
        given = {s: inputs.get(s) for s in self.sides}
        if all(value is not None for value in given.values()):
            self._targets = {s: value for s, value in given.items() if value is not None}
        return {
            s: tuple(
                JointCommand(self.dialect.mode(i, JointMode.FOC), q, self._dq, 0.0, kp, kd)
                for i, (q, (kp, kd)) in enumerate(zip(self._targets[s], self._gains, strict=True))
            )
            for s in self.sides
        }


class RightHandClient(FingerClient):
    """A client that waits for states of the right hand only
    (docs/sources/unitree-dex.md#j2).
    """

    @property
    def _awaited(self) -> Sequence[Side]:
        return (Side.RIGHT,)


class EitherHandClient(FingerClient):
    """A client that begins when some joint of either hand is not at 0
    (docs/sources/unitree-dex.md#j3).

    The genuine one begins after 5 s in any case.
    """

    @property
    def _awaited(self) -> Sequence[Side]:
        latest = self.receiver.seen
        return () if any(any(q) for q in latest.values()) else self.sides
