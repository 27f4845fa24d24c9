"""Teleoperation profiles, and the modelled operator who performs one.

A profile defines how far each joint is closed (0 open, 1 closed) as a function of time, the same
for both hands. :class:`Operator` makes of it what hand tracking would give the client, at the main
loop's 30 Hz, and what the operator's hand really did, which is what the robot's should do.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.models import Dialect, HandModel, model
from dexkit.teleop.client import PINCH_MAX, PINCH_MIN, Pose

__all__ = [
    "INPUT_RATE",
    "Operator",
    "Profile",
    "finger_profiles",
    "gripper_profiles",
    "recorded",
]

INPUT_RATE = 30.0
"""Hz at which hand tracking reaches the client: xr_teleoperate's main loop, ``--frequency``."""

Closing = Callable[[float], Pose | None]
"""Part by which each joint is closed, at a time in seconds; None while nothing is tracked."""


@dataclass(frozen=True)
class Profile:
    """One pattern of an operator's motion.

    :param lead_in: seconds at the beginning without tracking data.
    :param period: seconds after which it repeats.
    :param closing: of the time since the lead-in, one value for all joints, or one each.
    :param series: of a recording: per side, times and poses in rad, in place of ``closing``.
    """

    name: str
    model: str
    summary: str
    lead_in: float
    period: float
    closing: Closing
    series: Mapping[Side, tuple[Sequence[float], Sequence[Pose]]] = field(
        default_factory=lambda: MappingProxyType({})
    )

    @property
    def duration(self) -> float:
        """Seconds of one performance."""
        return self.lead_in + self.period


class Operator:
    """Performs a profile for hands of a dialect.

    :param most: how far each side may close, where something is in the way: 0 not at all, 1 all
        the way. The whole profile is squeezed into what is left.
    :param rate: Hz of the tracking data.
    """

    def __init__(
        self,
        chosen: Profile,
        spoken: Dialect,
        *,
        most: Mapping[Side, float] | None = None,
        rate: float = INPUT_RATE,
    ) -> None:
        if chosen.model != spoken.model:
            raise UsageError(f"the profile {chosen.name} is for a {model(chosen.model).title}")
        self.profile = chosen
        self.dialect = spoken
        self.rate = rate
        self._most = dict(most or {})
        self._joints = model(spoken.model).joints

    def intent(self, t: float, side: Side) -> Pose | None:
        """The operator's target for a hand at ``t`` seconds, rad; None without tracking data."""
        since = t - self.profile.lead_in
        if since < -1e-9:
            return None
        since = max(since, 0.0) % self.profile.period
        if self.profile.series:
            times, poses = self.profile.series.get(side, ((), ()))
            return poses[max(0, bisect_right(times, since) - 1)] if times else None
        closing = self.profile.closing(since)
        if closing is None:
            return None
        most = self._most.get(side, 1.0)
        return self._pose(side, tuple(most * part for part in closing))

    def _pose(self, side: Side, closing: Pose) -> Pose:
        joints = self._joints[side]
        parts = closing * len(joints) if len(closing) == 1 else closing
        if self.dialect.is_gripper:
            return (self.dialect.q_open * (1.0 - parts[0]),)
        return tuple(
            # the thumb's base swings both ways; closing a hand does not move it
            j.closed_by(part) if j.closing else 0.0
            for part, j in zip(parts, joints, strict=True)
        )

    def sampled_at(self, t: float) -> float:
        """When the tracking data that the client has at ``t`` was taken."""
        return math.floor(t * self.rate + 1e-6) / self.rate

    def inputs(self, t: float, sides: Iterable[Side]) -> dict[Side, Pose | None]:
        """The input of the client at ``t``, as :data:`dexkit.teleop.client.Inputs`."""
        at = self.sampled_at(t)
        return {s: self._input(self.intent(at, s)) for s in sides}

    def _input(self, pose: Pose | None) -> Pose | None:
        if pose is None or not self.dialect.is_gripper:
            return pose
        return (PINCH_MIN + (PINCH_MAX - PINCH_MIN) * pose[0] / self.dialect.q_open,)


def _between(a: float, b: float, part: float) -> float:
    """From a to b as a hand moves: smoothly (minimum jerk), part 0 to 1."""
    x = min(max(part, 0.0), 1.0)
    return a + (b - a) * x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


def _course(*points: tuple[float, float], move: float) -> Closing:
    """A course of (time, closing): from each time on it moves there within ``move`` seconds."""
    times = [t for t, _ in points]

    def closing(t: float) -> Pose:
        at = max(0, bisect_right(times, t) - 1)
        goal = points[at][1]
        before = points[at - 1][1]
        return (_between(before, goal, (t - times[at]) / move) if move else goal,)

    return closing


def _joined(first: float, one: Closing, two: Closing) -> Closing:
    """``one`` for so many seconds, then ``two``."""
    return lambda t: one(t) if t < first else two(t - first)


def _sine(low: float, high: float, period: float, begin: float = 0.0) -> Closing:
    """Between two closings.

    :param begin: phase at the beginning, degrees; 0 is the middle on the way to closed.
    """
    middle, swing, shift = (low + high) / 2, (high - low) / 2, math.radians(begin)
    return lambda t: (middle + swing * math.sin(2 * math.pi * t / period + shift),)


def _fingers(hand: HandModel, closing: Closing, **parts: float) -> Closing:
    """The same motion to different depths for the fingers of a hand.

    :param parts: of ``thumb``, ``middle`` and ``index``; other fingers move as the middle one does.
    """
    joints = hand.joints[Side.LEFT]
    each = tuple(parts.get(joint.finger, parts["middle"]) for joint in joints)

    def all_joints(t: float) -> Pose | None:
        found = closing(t)
        return None if found is None else tuple(p * found[0] for p in each)

    return all_joints


def _clear(hand: HandModel, closing: Closing) -> Closing:
    """A hand's fingers, and the thumb less far, clear of them."""
    return _fingers(hand, closing, thumb=0.4, middle=1.0, index=1.0)


_STEPS = _course((0.0, 0.2), (1.2, 0.4), (2.4, 0.6), (3.6, 0.8), (4.8, 0.5), move=0.0)
_GRASP = _course((0.0, 0.1), (0.8, 0.75), (2.8, 0.1), (3.6, 0.95), (5.2, 0.1), move=0.5)
_QUICK = _course(
    (0.0, 0.0), (1.0, 1.0), (1.6, 0.0), (2.2, 1.0), (2.6, 0.0), (3.0, 1.0), (3.25, 0.0), move=0.0
)
_STROKES = _course((0.0, 1.0), (2.0, 0.0), (4.0, 1.0), (6.0, 0.0), move=0.0)
# strokes, two steps clear of the stops (there is no overshoot at a stop), and a sine for the lag
_FEEL = _joined(
    6.2,
    _course((0.0, 1.0), (1.6, 0.0), (3.2, 1.0), (4.6, 0.35), (5.4, 0.7), move=0.0),
    _sine(0.2, 0.8, 4.0),
)
_JUST_MISSED = 0.4 + 0.001
"""A lead-in, s, after which steps at whole periods of the tracking data wait for the next one."""


def _check(stroke: float, step: float) -> Closing:
    """A stroke, a step clear of the stops, where a joint can overshoot, and a sine for the lag.

    :param stroke: seconds until the step: the joint has arrived and rests by then, as the client's
        filter may stick only then.
    :param step: seconds until the sine.
    """
    course = _course((0.0, 1.0), (stroke, 0.35), move=0.0)
    return _joined(stroke + step, course, _sine(0.2, 0.8, 4.0, begin=-30.0))


_CHECK = _check(1.5, 0.9)
# a gripper does not begin fully open, as a hand does whose client has no tracking data yet
_OPEN_AND_CHECK = _joined(0.6, _course((0.0, 0.0), move=0.0), _check(1.8, 1.0))


def finger_profiles(hand: HandModel) -> tuple[Profile, ...]:
    """The operator profiles of a hand of several joints."""
    return (
        Profile(
            "full-stroke",
            hand.name,
            "closed and open at once, two seconds each: how long a stroke takes",
            0.5,
            8.0,
            _clear(hand, _STROKES),
        ),
        Profile(
            "pinch",
            hand.name,
            "thumb against index finger and open again, twice",
            1.0,
            6.5,
            _fingers(hand, _GRASP, thumb=0.6, middle=0.1, index=0.6),
        ),
        Profile(
            "fist",
            hand.name,
            "the whole hand closes and opens, twice",
            1.0,
            6.5,
            _clear(hand, _GRASP),
        ),
        Profile(
            "steps",
            hand.name,
            "all joints, a fifth of the stroke at a time",
            0.5,
            6.0,
            _clear(hand, _STEPS),
        ),
        Profile(
            "sine",
            hand.name,
            "all joints to and fro, 4 s",
            0.5,
            8.0,
            _clear(hand, _sine(0.1, 0.9, 4.0)),
        ),
        Profile(
            "startle",
            hand.name,
            "nothing for 3 s, then quick full strokes down to 0.25 s",
            3.0,
            4.0,
            _clear(hand, _QUICK),
        ),
        Profile(
            "feel",
            hand.name,
            "all joints half closed, steps, sine",
            0.6,
            10.2,
            _fingers(hand, _FEEL, thumb=0.5, middle=0.5, index=0.5),
        ),
        Profile(
            "check",
            hand.name,
            "what the conformance suite does: all joints half closed, a step, sine",
            _JUST_MISSED,
            4.3,
            _fingers(hand, _CHECK, thumb=0.5, middle=0.5, index=0.5),
        ),
    )


def gripper_profiles(hand: HandModel) -> tuple[Profile, ...]:
    """The operator profiles of a gripper."""
    return (
        Profile(
            "full-stroke",
            hand.name,
            "closed and open at once, two seconds each: how long a stroke takes",
            0.5,
            8.0,
            _STROKES,
        ),
        Profile("steps", hand.name, "a fifth of the stroke at a time", 0.5, 6.0, _STEPS),
        Profile(
            "sine",
            hand.name,
            "slowly to and fro, 4 s: how far it lags",
            0.5,
            8.0,
            _sine(0.1, 0.9, 4),
        ),
        Profile(
            "pick-place", hand.name, "close, carry, open, twice, as a hand moves", 1.0, 6.5, _GRASP
        ),
        Profile(
            "startle",
            hand.name,
            "nothing for 3 s, then quick full strokes down to 0.25 s",
            3.0,
            4.0,
            _QUICK,
        ),
        Profile(
            "feel",
            hand.name,
            "strokes, steps, sine",
            0.6,
            10.2,
            _FEEL,
        ),
        Profile(
            "check",
            hand.name,
            "what the conformance suite does: strokes, a step, sine",
            0.4,
            4.9,
            _OPEN_AND_CHECK,
        ),
    )


def recorded(
    name: str,
    spoken: Dialect,
    series: Mapping[Side, tuple[Sequence[float], Sequence[Pose]]],
) -> Profile:
    """The commands of a recording as what an operator wants.

    A recorded Dex1-1 command is a short lead on the recorded hand, not what its operator wanted,
    so this operator is as slow as the recorded hand was; it shows whether another hand keeps up.

    :param series: per side, seconds from 0 and commanded poses in the radians of ``spoken``.
    :raises UsageError: there is nothing in it.
    """
    if not any(len(times) for times, _ in series.values()):
        raise UsageError(f"{name} holds no commands")
    end = max(times[-1] for times, _ in series.values() if len(times))
    return Profile(
        name,
        spoken.model,
        "the commands of a recording",
        0.5,
        end + 1.0,
        lambda t: None,
        {s: (list(times), list(poses)) for s, (times, poses) in series.items()},
    )
