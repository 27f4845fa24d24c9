"""Is q measured, or computed from the commands? What a run shows of it, with a confidence.

A service that has no sensor can publish a q that follows the commands like a good hand's. Each
observation is of something that the commands do not tell: where an object is, how stiff the drive
is, how heavy the mechanics are. A service that models all of that cannot be distinguished from a
hand by its topics alone; for that there is the manual test of docs/capabilities.md, which the
vendor claims.

The observations are not requirements: they pass or fail no hand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.median import median
from dexkit.conformance.recording import Recording, SideView
from dexkit.conformance.sums import total
from dexkit.hand import Floats, JointSpec
from dexkit.robots import RobotModel

__all__ = ["Confidence", "Finding", "MeasuredQ", "Observation", "measured_q", "solved"]

_FRESH = 0.1
"""Seconds: a command that is older may have been dropped by the hand's time-out."""
_LEAST = 0.12
"""Seconds for which a command stays the same at least, to be looked at."""
_WINDOW = 0.05
"""Seconds over which a position is taken."""
_STAYS = 0.5
"""Seconds for which a position is commanded until the joint has arrived, or is stopped."""
_AWAY = 0.03
"""Part of the stroke: a joint that rests farther from its goal has not arrived."""
_THERE = 0.02
"""Part of the stroke: a joint that rests nearer to its goal has arrived."""
_STILL = 0.01
"""Part of the stroke within which q stays at rest."""
_SHIFT = 0.003
"""Part of the stroke by which a change of gains or torque displaces q at least."""
_LIMP = 0.1
"""Part of the stroke between q and the goal of a command with zero gains."""
_FITS = 0.7
"""Part of the variance of tau_est that one mass with friction explains at least."""
_NOISE = 1e-6
"""Part of the stroke: less is the rounding of a computed float32."""
_SPAN = 5
"""States on either side over which a slope is taken."""
_FEW = 40
"""Fewest states in motion for a fit."""


class Finding(str, Enum):
    """Result of an observation."""

    SHOWS = "shows it"
    NO_SIGN = "no sign"
    CONTRADICTS = "contradicts it"
    NOT_TRIED = "not tried"

    def __str__(self) -> str:
        return self.value


class Confidence(str, Enum):
    """How sure it is that q is measured."""

    HIGH = "high"
    MEDIUM = "medium"
    LOW = "low"
    NONE = "none"
    CONTRADICTED = "contradicted"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Observation:
    """What one experiment shows.

    :param name: ``object``, ``torque``, ``gains``, ``limp``, ``noise`` or ``mass``.
    :param what: what was looked for, in words.
    :param figure: what was measured; empty if nothing was.
    """

    name: str
    what: str
    finding: Finding
    figure: str = ""

    def as_dict(self) -> dict[str, str]:
        """The observation as plain data."""
        return {
            "name": self.name,
            "what": self.what,
            "finding": str(self.finding),
            "figure": self.figure,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Observation:
        """Read it back from a result file."""
        return cls(**{**values, "finding": Finding(values["finding"])})


@dataclass(frozen=True)
class MeasuredQ:
    """What a run shows of one hand's q.

    :param side: of the hand.
    """

    side: str
    observations: tuple[Observation, ...]

    @property
    def confidence(self) -> Confidence:
        """Confidence from the observations; q that stops at an object counts most."""
        if any(o.finding is Finding.CONTRADICTS for o in self.observations):
            return Confidence.CONTRADICTED
        shown = [o.name for o in self.observations if o.finding is Finding.SHOWS]
        if "object" in shown:
            return Confidence.HIGH if len(shown) > 2 else Confidence.MEDIUM
        if len(shown) > 2:
            return Confidence.MEDIUM
        return Confidence.LOW if shown else Confidence.NONE

    def sentence(self) -> str:
        """The confidence in one sentence."""
        shown = [o.name for o in self.observations if o.finding is Finding.SHOWS]
        tried = [o for o in self.observations if o.finding is not Finding.NOT_TRIED]
        against = [o.name for o in self.observations if o.finding is Finding.CONTRADICTS]
        count = f"{len(shown)} of {len(tried)} observations"
        if self.confidence is Confidence.CONTRADICTED:
            text = f"contradicted ({', '.join(against)})"
        elif self.confidence is Confidence.NONE:
            text = "nothing shows it; make the manual test of docs/capabilities.md"
        else:
            text = f"{self.confidence} confidence ({count}: {', '.join(shown)})"
        return f"{self.side}: q is measured: {text}"

    def as_dict(self) -> dict[str, Any]:
        """The finding as plain data."""
        return {
            "side": self.side,
            "confidence": str(self.confidence),
            "sentence": self.sentence(),
            "observations": [o.as_dict() for o in self.observations],
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> MeasuredQ:
        """Read it back from a result file."""
        found = tuple(Observation.from_dict(o) for o in values["observations"])
        return cls(values["side"], found)


def measured_q(recording: Recording) -> tuple[MeasuredQ, ...]:
    """What a live run of the kit shows of the judged hands' q; empty for other recordings."""
    if recording.stimulus is None or isinstance(recording.model, RobotModel):
        return ()
    found = []
    for side in recording.judged:
        joints = [
            _Joint(recording, recording.sides[side], index)
            for index in range(len(recording.sides[side].joints))
        ]
        found.append(
            MeasuredQ(
                str(side),
                (
                    _object(joints),
                    _torque(joints),
                    _gains(joints),
                    _limp(joints),
                    _noise(joints),
                    _mass(joints),
                ),
            )
        )
    return tuple(found)


@dataclass(frozen=True)
class _Hold:
    """A stretch in which the command to a joint stays the same.

    :param begin: seconds; likewise ``end``.
    :param goal: q that was commanded, clipped to the joint's range; rad.
    :param q: median of q at its end, rad; NaN if that is not known.
    :param rests: whether the joint was at rest there.
    :param before: median of q just before it, rad; NaN if the joint was not at rest there.
    """

    begin: float
    end: float
    goal: float
    kp: float
    kd: float
    dq: float
    tau: float
    q: float
    rests: bool
    before: float

    @property
    def position(self) -> bool:
        """Whether the command is to a position alone."""
        return self.dq == 0 and self.tau == 0


class _Joint:
    """A joint's states, and the stretches of constant commands to it."""

    def __init__(self, recording: Recording, hand: SideView, index: int) -> None:
        self.spec: JointSpec = hand.joints[index]
        self.stroke = self.spec.stroke
        self.gains = recording.dialect.gains_are_used
        # a joint that closes on the object is commanded beyond it in these phases
        closes = self.spec.closing != 0
        phases = recording.phases("squeeze", hand.side) if closes else []
        self.squeezes = [
            (recording.seconds(p.begin_ns), recording.seconds(p.end_ns)) for p in phases
        ]
        states, commands = hand.states, hand.commands
        self.t, self.q, self.tau = states.t, states.q[:, index], states.tau[:, index]
        self._sent = commands.t
        self._fields = np.stack(
            [getattr(commands, name)[:, index] for name in ("q", "kp", "kd", "dq", "tau")], axis=1
        )

    @cached_property
    def holds(self) -> list[_Hold]:
        """Stretches of equal finite commands without a pause, of :data:`_LEAST` or longer."""
        sent, fields = self._sent, self._fields
        if len(sent) < 2:
            return []
        changed = (fields[1:] != fields[:-1]).any(axis=1) | (np.diff(sent) > _FRESH)
        edges = np.concatenate(([0], np.flatnonzero(changed) + 1, [len(sent)]))
        found = []
        for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            begin, end = float(sent[first]), float(sent[last - 1])
            row = fields[first]
            if end - begin < _LEAST or not np.isfinite(row).all():
                continue
            q, kp, kd, dq, tau = (float(v) for v in row)
            goal = min(max(q, self.spec.q_min), self.spec.q_max)
            here, rests = self._position(end)
            before, rested = self._position(begin)
            if not rested:
                before = math.nan
            found.append(_Hold(begin, end, goal, kp, kd, dq, tau, here, rests, before))
        return found

    def _position(self, end: float) -> tuple[float, bool]:
        """The median of q before ``end``, NaN if that is not known, and whether the joint rests."""
        q = self.between(self.q, end - _WINDOW, end)
        if len(q) < 3 or not np.isfinite(q).all():
            return math.nan, False
        return median(q), float(q.max()) - float(q.min()) <= _STILL * self.stroke

    def between(self, column: Floats, begin: float, end: float) -> Floats:
        """The values of a column of states received in [begin, end]."""
        first, last = np.searchsorted(self.t, (begin, end))
        return column[int(first) : int(last)]

    @cached_property
    def driven(self) -> list[_Hold]:
        """Longer holds of a position with a stiffness, which ended at rest."""
        return [
            h
            for h in self.holds
            if h.position and h.rests and h.end - h.begin >= _STAYS and (h.kp > 0 or not self.gains)
        ]


def _counted(name: str, what: str, joints: Sequence[bool | None], extra: str = "") -> Observation:
    """An observation that each joint shows (True), does not show (False), or was not tried for."""
    tried = [j for j in joints if j is not None]
    if not tried:
        return Observation(name, what, Finding.NOT_TRIED)
    shown = sum(tried)
    finding = Finding.SHOWS if 2 * shown >= len(tried) else Finding.NO_SIGN
    figure = extra if len(joints) == 1 else f"{shown} of {len(tried)} joints"
    return Observation(name, what, finding, figure)


def _object(joints: Sequence[_Joint]) -> Observation:
    """Joints that stop short of a goal, while they arrive at others."""
    what = "an object stops q short of its goal; free, the same joint arrives"
    shown = 0
    deepest = 0.0
    pressed: list[float] = []
    for joint in joints:
        ends = [(abs(h.q - h.goal) / joint.stroke, h) for h in joint.driven]
        squeezing = [
            part
            for part, h in ends
            if any(begin <= h.begin <= end for begin, end in joint.squeezes)
        ]
        stopped = [part for part in squeezing if part >= _AWAY]
        arrived = [part for part, _ in ends if part <= _THERE]
        if stopped and arrived:
            shown += 1
            deepest = max(deepest, *stopped)
        pressed += squeezing
    if pressed and max(pressed) <= _THERE:
        return Observation(
            "object", what, Finding.CONTRADICTS, "q goes through the object to its goal"
        )
    if shown:
        where = "" if len(joints) == 1 else f" ({shown} of {len(joints)} joints)"
        return Observation(
            "object", what, Finding.SHOWS, f"up to {deepest:.0%} of the stroke short{where}"
        )
    return Observation("object", what, Finding.NO_SIGN if pressed else Finding.NOT_TRIED)


def _changes(joint: _Joint) -> list[tuple[_Hold, _Hold]]:
    """Holds of one goal, of which the second follows the first at once."""
    return [
        (a, b)
        for a, b in zip(joint.holds, joint.holds[1:], strict=False)
        if a.goal == b.goal and b.begin - a.end <= _FRESH and a.dq == b.dq == 0
    ]


def _torque(joints: Sequence[_Joint]) -> Observation:
    """Joints that a torque displaces while their goal stays the same."""
    what = "a torque displaces q, though the goal stays the same"
    shown: list[bool | None] = []
    most = 0.0
    for joint in joints:
        parts = [
            (b.q - a.q) * math.copysign(1.0, b.tau - a.tau) / joint.stroke
            for a, b in _changes(joint)
            if a.tau != b.tau and a.kp == b.kp and a.rests and math.isfinite(b.q)
        ]
        shown.append(bool(max(parts) >= _SHIFT) if parts else None)
        most = max(most, *parts, 0.0)
    return _counted("torque", what, shown, f"by {most:.1%} of the stroke")


def _gains(joints: Sequence[_Joint]) -> Observation:
    """Joints whose q, held off their goal, changes with the gains alone."""
    what = "another stiffness changes q of a joint that is held off its goal"
    shown: list[bool | None] = []
    most = 0.0
    for joint in joints:
        parts = [
            abs(b.q - a.q) / joint.stroke
            for a, b in _changes(joint)
            if a.tau == b.tau == 0
            and a.kp != b.kp
            and a.rests
            and b.rests
            and abs(a.q - a.goal) >= _THERE * joint.stroke
        ]
        shown.append(bool(max(parts) >= _SHIFT) if joint.gains and parts else None)
        most = max(most, *parts, 0.0)
    return _counted("gains", what, shown, f"by {most:.1%} of the stroke")


def _limp(joints: Sequence[_Joint]) -> Observation:
    """Joints that do not go to the q of commands with zero gains."""
    what = "with zero gains q does not go to the commanded q"
    shown: list[bool | None] = []
    most = 0.0
    for joint in joints:
        parts = [
            abs(h.q - h.before) / abs(h.goal - h.before)
            for h in joint.holds
            if h.position
            and h.kp == h.kd == 0
            and joint.gains
            and math.isfinite(h.before)
            and math.isfinite(h.q)
            and abs(h.goal - h.before) >= _LIMP * joint.stroke
        ]
        shown.append(max(parts) < 0.5 if parts else None)
        most = max(most, *parts, 0.0)
    return _counted("limp", what, shown, f"at most {most:.0%} of the way")


def _noise(joints: Sequence[_Joint]) -> Observation:
    """Joints whose q is not constant at rest under a constant command."""
    what = "q at rest has the noise of a sensor, not always the same"
    shown: list[bool | None] = []
    floors: list[float] = []
    loaded: list[float] = []
    for joint in joints:
        free: list[float] = []
        for h in joint.driven:
            q = joint.between(joint.q, h.end - _WINDOW, h.end)
            spread = total(np.abs(q - h.q)) / len(q) / joint.stroke
            held = abs(h.q - h.goal) >= _AWAY * joint.stroke
            (loaded if held else free).append(spread)
        shown.append(_middle(free) > _NOISE if len(free) > 1 else None)
        floors += free
    text = f"{_middle(floors):.2g} of the stroke free"
    if loaded:
        text += f", {_middle(loaded):.2g} held off its goal"
    found = _counted("noise", what, shown, text)
    return found if len(joints) == 1 or not floors else replace(found, figure=text)


def _middle(values: Sequence[float]) -> float:
    return median(np.asarray(values, dtype=np.float64)) if values else 0.0


def _mass(joints: Sequence[_Joint]) -> Observation:
    """Joints whose tau_est in free motion is what q's acceleration and speed ask for."""
    what = "tau_est moves one mass with friction as q says"
    shown: list[bool | None] = []
    best = 0.0
    for joint in joints:
        part = _explained(joint)
        shown.append(None if part is None else part >= _FITS)
        best = max(best, part or 0.0)
    return _counted("mass", what, shown, f"{best:.0%} of the variance explained")


def _explained(joint: _Joint) -> float | None:
    """Part of the variance of tau_est, 0 to 1, that a mass with viscous and dry friction explains.

    Speed and acceleration are those of q, so that it is q which the mass explains. None if tau_est
    is not filled, or the joint hardly moves.
    """
    t, q, tau = joint.t, joint.q, joint.tau
    if len(t) < 4 * _SPAN + _FEW:
        return None
    lap = t[2 * _SPAN :] - t[: -2 * _SPAN]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (q[2 * _SPAN :] - q[: -2 * _SPAN]) / lap  # at t[_SPAN:-_SPAN]
        change = (slope[2 * _SPAN :] - slope[: -2 * _SPAN]) / lap[_SPAN:-_SPAN]
    v, y = slope[_SPAN:-_SPAN], tau[2 * _SPAN : -2 * _SPAN]
    usable: NDArray[np.bool_] = np.abs(v) > 0.1 * joint.stroke
    usable &= np.isfinite(change) & np.isfinite(v) & np.isfinite(y)
    usable &= (lap[_SPAN:-_SPAN] < 0.1) & (lap[2 * _SPAN :] < 0.1) & (lap[: -2 * _SPAN] < 0.1)
    y, v, a = y[usable], v[usable], change[usable]
    if len(y) < _FEW or not y.any():
        return None
    columns = [a, v, np.sign(v), np.ones(len(y))]
    rows = [[total(p * r) for r in columns] + [total(p * y)] for p in columns]
    found = solved(rows)
    if found is None:
        return None
    rest = y - sum(c * p for c, p in zip(found, columns, strict=True))
    mean = total(y) / len(y)
    whole = total((y - mean) ** 2)
    return max(0.0, 1.0 - total(rest**2) / whole) if whole > 0 else None


def solved(rows: list[list[float]]) -> list[float] | None:
    """Solve linear equations, each row with its right-hand side; None if they are singular.

    In pure Python, so that the result is the same on every machine.
    """
    size = len(rows)
    for i in range(size):
        pivot = max(range(i, size), key=lambda r: abs(rows[r][i]))
        if abs(rows[pivot][i]) < 1e-12:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for r in range(i + 1, size):
            factor = rows[r][i] / rows[i][i]
            rows[r] = [x - factor * y for x, y in zip(rows[r], rows[i], strict=True)]
    found = [0.0] * size
    for i in reversed(range(size)):
        known = sum(rows[i][c] * found[c] for c in range(i + 1, size))
        found[i] = (rows[i][size] - known) / rows[i][i]
    return found
