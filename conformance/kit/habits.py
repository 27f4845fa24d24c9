"""Habits of a hand: what goes wrong in its motion, its grips and its states over a whole run.

A requirement judges one situation. A joint that begins every step late fails in each of them, and
the report of a single one sends its reader to the wrong place. So all plain steps of a joint are
compared: how many go wrong, in which way, and, where only some do, what these have in common (goals
beyond a place, a rest before, a stretch of the run). Grips and the times of states likewise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dexkit.conformance.kit.recording import Recording, SideView
from dexkit.conformance.kit.state_faults import joints_in_words
from dexkit.hand import Floats
from dexkit.models import model

__all__ = ["Habit", "habits", "silences"]

_PLAIN = (
    *("joint", "step", "ends", "fingerprint", "center", "recover", "resume", "company", "restart"),
    *("service-restart", "beside", "beside-grip", "guarded-step", "guard-clear"),
)
"""Phases with good commands and targets that are free to be reached."""
_PROVOCATIONS = (
    *("nan", "out-of-range", "empty", "short", "long", "negative", "wrong-id", "foreign", "burst"),
    *("silence", "rejected", "grip", "squeeze", "two-writers", "company", "restart", "shutdown"),
    *("load", "lock", "limp", "push", "guard", "touch", "operator", "replay"),
)
"""Phases after which a hand may be another one."""
_LEAST_WAY, _WAY = 0.025, 0.08
"""Part of the stroke that a step has to ask for; for how it moves, and not only whether."""
_FEWEST = 3
"""Fewest steps that show a habit, and fewest others."""
_ALWAYS, _PURE = 0.6, 0.9
"""Part of all steps that is a habit; part that a condition has to tell rightly, of those that go
wrong and of those that it names."""
_STILL = 0.015
"""Part of the stroke that a joint makes that does not move; play and gravity make some."""
_BEGUN = 0.04
"""Part of the stroke after which it has begun to move."""
_LATE_S, _LATE_SERVO_S = 0.2, 0.5
"""Beginning of a motion that is late; that of a hand with a control of its own."""
_SLOW, _SLOW_WAY = 0.35, 0.2
"""Strokes per second of a slow joint, and the part of the stroke from which that is judged."""
_SPEED_S = 0.1
"""Window of a speed, seconds."""
_SLOWER, _SPEED = 0.4, 3.0
"""Part of the speed of a smaller step that is slow for a joint that can do better; and steps per
second that are not slow in any case."""
_PAST, _PAST_STROKE = 0.2, 0.06
"""Part of a step, and of the stroke, by which a joint swings past its target."""
_SHORT = 0.02
"""Part of the stroke from its target at which a joint ends short."""
_GRIPS = ("grip", "squeeze", "regrip", "soft-grip", "firmer")
_STREAMS = ("operator", "replay")
_LAGS = tuple(0.02 * i for i in range(51))
"""Seconds by which a hand may be behind a stream of targets."""
_BEHIND_S, _OFF, _NEARER = 0.3, 0.05, 0.8
"""Seconds that are much; the part of the stroke by which q is off then; and the part of that by
which it is off the targets that it follows."""
_LEAST_GRIP_S, _PRESSES, _FADED = 0.7, 0.02, 0.5
"""Shortest grip that may fade, seconds; the part of a joint's torque that presses; and the part of
that which is left where it fades."""
_BURST_S, _GAP_S = 0.0005, 0.05
"""Seconds between states of one burst at most, and between two bursts at least."""
_SILENT = 0.1
"""Part of a run without states that is a habit."""
_RESTS = 0.003
"""Part of the stroke by which a joint that rests may move."""
_ALIKE = 0.03
"""Part of the stroke by which places are the same."""


@dataclass(frozen=True)
class Habit:
    """What goes wrong in all steps, or in all of a kind.

    :param joints: of which joints.
    :param during: seconds from which and until which steps that go wrong begin.
    :param spans: those steps, seconds of the recording.
    """

    kind: str
    sentence: str
    joints: tuple[int, ...]
    during: tuple[float, float]
    spans: tuple[tuple[float, float], ...]


class _Step(NamedTuple):
    """A plain step of one joint; ways in strokes.

    :param rest: seconds since any joint of the hand last moved.
    :param together: joints of the hand that are commanded to move with it.
    :param late: seconds until it began to move.
    """

    joint: int
    begin: float
    end: float
    goal: float
    size: float
    rest: float
    together: int
    way: float
    late: float
    speed: float
    past: float
    final: float
    moves: bool
    slower: bool


class _Kind(NamedTuple):
    """A way to go wrong.

    :param least: part of the stroke of a step that shows it.
    :param wrong: whether a step goes wrong so.
    :param seen: that in words, of those that do.
    """

    name: str
    least: float
    wrong: Callable[[_Step], bool]
    seen: Callable[[Sequence[_Step], float, str], str]


def habits(recording: Recording, view: SideView) -> Iterator[Habit]:
    """The habits of one hand: grips that fade, a lag behind moving targets, and those of single
    steps, that of most steps first.
    """
    steps = _with_slower(list(_steps(recording, view)))
    found = []
    told: set[int] = set()
    for kind in _kinds(recording):
        alike: dict[str, list[_Step]] = {}
        for joint in set(range(len(view.joints))) - told:
            mine = [s for s in steps if s.joint == joint and abs(s.size) >= kind.least]
            wrong = [s for s in mine if kind.wrong(s)]
            when = _common(mine, wrong)
            if when is not None:
                alike.setdefault(when, []).extend(wrong)
        for when, wrong in alike.items():
            found.append(_habit(recording, view, kind, when, wrong, steps))
            told |= {s.joint for s in wrong}
    yield from _fading_grips(recording, view)
    yield from _behind_a_stream(recording, view)
    yield from sorted(found, key=lambda habit: -len(habit.spans))


# --------------------------------------------------------------------------- states and grips


def silences(recording: Recording, view: SideView) -> Iterator[Habit]:
    """States that come in bursts, or not while the hand rests."""
    states = view.states
    between = np.diff(states.t)
    ended = [recording.seconds(p.begin_ns) for p in recording.phases("shutdown")]
    long = between > _GAP_S
    for at in ended:  # until it is there again
        long &= ~((states.t[1:] > at) & (states.t[:-1] < at + 3.0))
    gaps = np.flatnonzero(long)
    if len(gaps) < _FEWEST or between[gaps].sum() < _SILENT * recording.duration:
        return
    often, lasts = len(gaps), float(np.median(between[gaps]))
    spans = tuple((float(states.t[i]), float(states.t[i + 1])) for i in gaps)
    strokes = np.array([j.stroke for j in view.joints])
    moved = (np.abs(states.q[gaps + 1] - states.q[gaps]) / strokes).max(axis=1)
    if float((between < _BURST_S).mean()) > _ALWAYS:
        text = (
            f"states come in bursts: {np.median(np.diff(gaps)):.0f} at once (median), "
            f"{lasts:.2f} s apart, {often} times"
        )
    elif float((moved < _STILL).mean()) >= _PURE:
        text = (
            f"no states while the hand rests: {often} times, for up to {between[gaps].max():.2g} s"
        )
    else:
        text = f"no states for {lasts:.2f} s (median), {often} times"
    yield Habit("silent", text, (), (0.0, np.inf), spans)


def _fading_grips(recording: Recording, view: SideView) -> Iterator[Habit]:
    """Grips whose torque falls while the command stays the same."""
    states, commands = view.states, view.commands
    pressed: list[float] = []
    faded: list[tuple[float, float, float, float, float, int]] = []
    for phase in (p for name in _GRIPS for p in recording.phases(name, view.side)):
        begin, end = recording.seconds(phase.begin_ns), recording.seconds(phase.end_ns)
        given = commands.q[(commands.t >= begin + 0.1) & (commands.t <= end)]
        rows = states.between(begin + 0.2, end)
        t, tau = states.t[rows], np.abs(states.tau[rows])
        same = len(given) and np.ptp(given, axis=0).max() == 0
        if end - begin < _LEAST_GRIP_S or not same or len(t) < 2 or not np.isfinite(tau).all():
            continue
        peak, left = np.quantile(tau, 0.9, axis=0), np.median(tau[t >= end - 0.15], axis=0)
        presses = peak > _PRESSES * np.array([j.tau_max for j in view.joints])
        if presses.any():
            pressed.append(end - begin)
        for joint in np.flatnonzero(presses & (left < _FADED * peak)):
            strong = np.flatnonzero(tau[:, joint] > 0.5 * (peak[joint] + left[joint]))
            after = float(t[strong[-1]]) - begin
            faded.append((begin, end, after, float(peak[joint]), float(left[joint]), int(joint)))
    if not faded:
        return
    _, _, after, first, last, _ = np.median(np.array(faded), axis=0).tolist()
    spans = tuple(dict.fromkeys((begin, end) for begin, end, *_ in faded))
    long = sum(seconds > min(row[2] for row in faded) + 0.2 for seconds in pressed)
    long = max(long, len(spans))
    if len(spans) >= 0.5 * long:
        joints = tuple(sorted({row[5] for row in faded}))
        name = joints_in_words(view, joints).removeprefix(" of ")
        unit = model(recording.dialect.model).torque_unit
        text = (
            f"presses with {first:.2f} {unit} in a grip, and {after:.1f} s after its command with "
            f"{last:.2f} {unit}, in {len(spans)} of {long} grips of that length"
        )
        yield Habit("fades", f"{name}: {text}" if name else text, joints, (0.0, np.inf), spans)


def _behind_a_stream(recording: Recording, view: SideView) -> Iterator[Habit]:
    """How far joints are behind targets that move all the time."""
    states, commands = view.states, view.commands
    behind: dict[int, float] = {}
    spans = []
    for phase in (p for name in _STREAMS for p in recording.phases(name, view.side)):
        begin, end = recording.seconds(phase.begin_ns), recording.seconds(phase.end_ns)
        at = np.arange(begin + _LAGS[-1], end, 0.005)
        if not len(at) or not len(commands):
            continue
        rows = [np.searchsorted(commands.t, at - lag, "right") - 1 for lag in _LAGS]
        for joint, spec in enumerate(view.joints):
            goals = np.clip(commands.q[:, joint], spec.q_min, spec.q_max) / spec.stroke
            q = np.interp(at, states.t, states.q[:, joint]) / spec.stroke
            off = [float(np.abs(q - goals[np.maximum(row, 0)]).mean()) for row in rows]
            best = int(np.argmin(off))
            if _LAGS[best] > _BEHIND_S and off[0] > _OFF and off[best] < _NEARER * off[0]:
                behind[joint] = max(behind.get(joint, 0.0), _LAGS[best])
                spans.append((begin, end))
    if behind:
        name = joints_in_words(view, sorted(behind)).removeprefix(" of ")
        lag = float(np.median(list(behind.values())))
        text = f"follows a moving target {lag:.2f} s late"
        text = f"{name}: {text}" if name else text
        places = tuple(dict.fromkeys(spans))
        yield Habit("stream", text, tuple(sorted(behind)), (0.0, np.inf), places)


# ------------------------------------------------------------------------------------- motion


def _habit(
    recording: Recording,
    view: SideView,
    kind: _Kind,
    when: str,
    wrong: Sequence[_Step],
    steps: Sequence[_Step],
) -> Habit:
    joints = tuple(sorted({s.joint for s in wrong}))
    name = joints_in_words(view, joints).removeprefix(" of ")
    text = kind.seen(wrong, view.joints[joints[0]].stroke, recording.unit)
    every = [s for s in steps if s.joint in joints and abs(s.size) >= kind.least]
    if when:
        condition = _words(recording, when, wrong, every)
        text += (
            f" in {len(wrong)} steps {condition}, in hardly any of {len(every) - len(wrong)} others"
        )
    else:
        text += f" in {len(wrong)} of {len(every)} steps"
    begins = [s.begin for s in wrong]
    during = (min(begins), max(begins)) if when == "during" else (0.0, np.inf)
    spans = tuple((s.begin, s.end) for s in sorted(wrong, key=lambda s: s.begin))
    return Habit(kind.name, f"{name}: {text}" if name else text, joints, during, spans)


def _common(steps: Sequence[_Step], wrong: Sequence[_Step]) -> str | None:
    """What the steps that go wrong have in common, a name in :data:`_FEATURES`; empty for nothing,
    as most do; None where they are no habit.
    """
    if len(wrong) < _FEWEST:
        return None
    bad = np.array([s in wrong for s in steps])
    best, name = 0.0, ""
    for feature, value in _FEATURES.items():
        values = np.array([value(s) for s in steps])
        # the few that are told wrongly may be the outermost ones
        for limit in np.unique(values[bad])[: 1 + len(wrong) // 10]:
            told = values >= limit
            if feature == "during":
                told &= values <= values[bad].max()
                if (~told).sum() < _FEWEST:
                    continue
            score = float((told & bad).sum() / (told | bad).sum())
            if score > best + 0.02:
                best, name = score, feature
    always = len(wrong) >= _ALWAYS * len(steps)
    if name == "small" and any(s.way >= _STILL for s in wrong):
        return "" if always else None  # a long way shows as much
    if always and name == "large":  # a short way shows less
        return ""
    if best >= _PURE and len(steps) - len(wrong) >= _FEWEST:
        return name
    return "" if always else None


def _words(
    recording: Recording, feature: str, wrong: Sequence[_Step], every: Sequence[_Step]
) -> str:
    """What the steps that go wrong have in common."""
    least = min(_FEATURES[feature](s) for s in wrong)
    if feature == "during":
        last = max(s.begin for s in wrong)
        before = max((s.end for s in every if s.end <= least), default=0.0)
        phases = recording.stimulus.phases if recording.stimulus else ()
        names = dict.fromkeys(
            p.name
            for p in phases
            if p.name in _PROVOCATIONS
            and before - 0.05 <= recording.seconds(p.begin_ns) <= least + 0.05
        )
        after = f" (after {', '.join(names)})" if 0 < len(names) < 4 else ""
        return f"from {least:.1f} s to {last:.1f} s{after}"
    if feature in ("above", "below") and len({s.joint for s in wrong}) > 1:
        return "beyond a part of the range"
    return {
        "above": f"to {least:.2f} {recording.unit} and more",
        "below": f"to {-least:.2f} {recording.unit} and less",
        "small": f"of {-least:.2g} strokes and less",
        "large": f"of {least:.2g} strokes and more",
        "rest": f"after a rest of {least:.1f} s and more",
        "together": f"of {least:.0f} joints and more at once",
    }[feature]


_FEATURES: dict[str, Callable[[_Step], float]] = {
    "during": lambda s: s.begin,
    "above": lambda s: s.goal,
    "below": lambda s: -s.goal,
    "together": lambda s: s.together,
    "rest": lambda s: s.rest,
    "small": lambda s: -abs(s.size),
    "large": lambda s: abs(s.size),
}
"""What steps that go wrong may have in common: to be at least so much."""


def _steps(recording: Recording, view: SideView) -> Iterator[_Step]:
    """The plain steps of a hand."""
    if recording.stimulus is None:
        return
    held = recording.stimulus.objects.get(view.side) is not None
    states = view.states
    strokes = np.array([j.stroke for j in view.joints])
    later = np.minimum(np.searchsorted(states.t, states.t + 0.05), len(states) - 1)
    moving = np.abs((states.q[later] - states.q) / strokes).max(axis=1) > _RESTS
    moved = states.t[moving]
    for phase in sorted(recording.stimulus.phases, key=lambda p: p.begin_ns):
        targets = phase.targets.get(view.side, {})
        begin, end = recording.seconds(phase.begin_ns), recording.seconds(phase.end_ns)
        rows, before = states.between(begin, end), states.between(begin - 0.1, begin)
        t = states.t[rows]
        if phase.name in _PLAIN and not (held and phase.name == "ends") and len(t) > 2:
            q, earlier = states.q[rows], states.q[before]
            start = np.median(earlier, axis=0) if len(earlier) else q[0]
            earlier_moved = moved[: int(np.searchsorted(moved, begin - 0.05))]
            rest = begin - float(earlier_moved[-1]) if len(earlier_moved) else begin
            sizes = {j: (goal - start[j]) / strokes[j] for j, goal in targets.items()}
            together = sum(abs(size) > _WAY for size in sizes.values())
            for joint, size in sizes.items():
                if abs(size) > _LEAST_WAY and np.isfinite(q[:, joint]).all():
                    way = (q[:, joint] - start[joint]) / strokes[joint] * np.sign(size)
                    yield _step(
                        joint,
                        t - begin,
                        way,
                        targets[joint],
                        float(size),
                        begin,
                        end,
                        rest,
                        together,
                    )


def _with_slower(steps: Sequence[_Step]) -> list[_Step]:
    """The steps, and which of them are slower than others of the joint that are not larger."""
    found = []
    for s in steps:
        others = [o.speed for o in steps if o.joint == s.joint and abs(o.size) <= 1.2 * abs(s.size)]
        found.append(s._replace(slower=s.speed < min(_SLOWER * max(others), _SPEED * abs(s.size))))
    return found


def _step(
    joint: int,
    t: Floats,
    way: Floats,
    goal: float,
    size: float,
    begin: float,
    end: float,
    rest: float,
    together: int,
) -> _Step:
    asked = abs(size)
    begun = way > min(_BEGUN, 0.5 * asked)
    late = float(t[int(np.argmax(begun))]) if begun.any() else end - begin
    final = float(np.median(way[t >= t[-1] - 0.06]))
    later = np.minimum(np.searchsorted(t, t + _SPEED_S), len(t) - 1)
    speed = float(np.max((way[later] - way) / np.maximum(t[later] - t, _SPEED_S)))
    near = t >= t[-1] - 0.1
    return _Step(
        slower=False,
        joint=joint,
        begin=begin,
        end=end,
        goal=goal,
        size=size,
        rest=rest,
        together=together,
        way=float(np.abs(way).max()),
        late=late,
        speed=speed,
        past=float(way.max()) - asked,
        final=final - asked,
        moves=float(way[-1] - way[near][0]) > 0.001,
    )


def _kinds(recording: Recording) -> tuple[_Kind, ...]:
    due = _LATE_S if recording.dialect.gains_are_used else _LATE_SERVO_S
    return (
        _Kind("still", _LEAST_WAY, lambda s: s.way < _STILL, lambda *_: "no motion"),
        _Kind(
            "slow",
            _WAY,
            lambda s: (
                s.way >= _STILL
                and (s.slower or s.speed < _SLOW * min(abs(s.size) / _SLOW_WAY, 1.0))
            ),
            lambda some, stroke, unit: (
                f"moves at {_median(s.speed for s in some) * stroke:.2g} {unit}/s at most (median)"
            ),
        ),
        _Kind(
            "late",
            _WAY,
            lambda s: s.late > due,
            lambda some, stroke, unit: (
                f"begins to move {_median(s.late for s in some):.2f} s late (median)"
            ),
        ),
        _Kind(
            "past",
            _WAY,
            lambda s: s.past > max(_PAST * abs(s.size), _PAST_STROKE),
            lambda some, stroke, unit: (
                f"swings past its target by {_median(s.past for s in some) * stroke:.2g} {unit} "
                "(median)"
            ),
        ),
        _Kind("short", _WAY, lambda s: abs(s.final) > _SHORT and not s.moves, _ends_short),
    )


def _ends_short(some: Sequence[_Step], stroke: float, unit: str) -> str:
    ends = np.array([s.goal + s.final * stroke * np.sign(s.size) for s in some])
    goals = np.array([s.goal for s in some])
    if np.ptp(ends) < _ALIKE * stroke < np.ptp(goals) or np.ptp(ends) < 0.003 * stroke:
        return f"stops at {np.median(ends):.2f} {unit}"
    return (
        f"ends {_median(abs(s.final) for s in some) * stroke:.2g} {unit} from its target (median)"
    )


def _median(values: Iterator[float]) -> float:
    return float(np.median(list(values)))
