"""Faults that the states of a recording show by themselves, and the states without each.

A :class:`Fault` is a sentence of counted and measured figures, with the states as they would be
without it. Judging those again (:mod:`~dexkit.conformance.kit.stories`) tells which failures follow
from the fault: they are met then.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.kit.recording import Recording, SideView, States
from dexkit.hand import Floats

__all__ = ["Fault", "faults", "joints_in_words"]

Span = tuple[float, float]
Run = tuple[int, int]
"""First row of a stretch of states, and the row after its last."""
Flags = NDArray[np.bool_]

_FEWEST, _MOST = 50, 600_000
"""States of a recording in which faults are looked for; more take too long."""
_AWAY_S = 0.6
"""Longest time for which states may leave the course of the others and come back."""
_FASTEST = 8.0
"""Strokes per second that no hand moves with."""
_LEAST_JUMP = 0.015
"""Part of the stroke that q has to jump by."""
_WRAPS = 0.5
"""Part of the stroke that q jumps by where it wraps around."""
_SAME_JUMP = 0.35
"""Part of a jump by which the jump back may differ: the joint moves on meanwhile."""
_AT_LEAST = 3
"""Fewest times that states repeat old values, or that a joint freezes: once may be chance."""
_HELD_S = 0.03, 0.5
"""Time of equal positions before a jump: a shorter one is no freezing, a longer one may be rest."""
_HELD_STATES = 8
"""Fewest states in that time."""
_SLOPE_S = 0.02
"""Time that a slope of q is taken over, seconds."""
_MOVING = 0.1
"""Strokes per second from which a joint moves."""
_ALIKE = 0.6
"""Correlation below which dq has nothing to do with the slope of q."""
_TRUE = 0.7, 1.4
"""dq over the slope of q that needs no word."""


@dataclass(frozen=True)
class Fault:
    """What the states of a hand show, and what they would be without it.

    :param kind: the same for the same fault of other hands.
    :param sentence: what was counted and measured.
    :param spans: where, seconds of the recording; empty for everywhere.
    """

    kind: str
    sentence: str
    spans: tuple[Span, ...]
    states: States


def faults(recording: Recording, view: SideView) -> Iterator[Fault]:
    """The faults that the states of one hand show, the simplest first."""
    if not _FEWEST <= len(view.states) <= _MOST:
        return
    for found in (
        _all_zero(view),
        _zero_at_first(view),
        _wraps(recording, view),
        _old_values(view),
        _jumps_and_returns(recording, view),
        _frozen_joints(view),
        _wrong_velocity(view),
    ):
        if found is not None:
            yield found


# -------------------------------------------------------------------------------- some states


def _all_zero(view: SideView) -> Fault | None:
    """States in which q, dq and tau_est are exactly 0, between others."""
    states = view.states
    zero = ~(states.q.any(axis=1) | states.dq.any(axis=1) | states.tau.any(axis=1))
    runs = [(a, b) for a, b in _runs(np.asarray(zero)) if states.t[b - 1] - states.t[a] <= _AWAY_S]
    if not runs or not states.q[~zero].any():
        return None
    what = f"q, dq and tau_est{joints_in_words(view, range(len(view.joints)))}"
    text = f"{what} are exactly 0 in {_counted(states, runs)}"
    return Fault("zero", text, _spans(states, runs), _bridged(states, _flags(states, runs)))


def _zero_at_first(view: SideView) -> Fault | None:
    """States whose q is exactly 0 until the first command, and then jumps to where the hand is."""
    states, commands = view.states, view.commands
    strokes = np.array([j.stroke for j in view.joints])
    found = []
    for begin, end in _runs(np.asarray(~states.q.any(axis=1))):
        began = begin == 0 or states.t[begin] - states.t[begin - 1] > _AWAY_S
        if not began or end == len(states) or end - begin < _HELD_STATES:
            continue
        at = float(states.t[end])
        given = commands.t[commands.t <= at]
        fresh = given[given > at - _AWAY_S]
        older = len(fresh) < len(given) and given[-len(fresh) - 1] >= states.t[begin]
        jumps = (np.abs(states.q[end]) > _LEAST_JUMP * strokes).any()
        if jumps and len(fresh) and not older:
            found.append((begin, end))
    if not found:
        return None
    begin, end = found[0]
    text = (
        f"q{joints_in_words(view, range(len(strokes)))} is exactly 0 in all {end - begin} states "
        f"before the first command, and then {states.q[end][np.abs(states.q[end]).argmax()]:.2f}"
    )
    return Fault("asleep", text, _spans(states, found), _bridged(states, _flags(states, found)))


def _wraps(recording: Recording, view: SideView) -> Fault | None:
    """A q that wraps around: it jumps by the same number down and up."""
    states = view.states
    q, times, joints, sizes, spans = states.q.copy(), 0, [], [], []
    for joint, spec in enumerate(view.joints):
        step = np.diff(q[:, joint])
        fast = np.abs(step) > _FASTEST * spec.stroke * np.minimum(np.diff(states.t), 0.01)
        jumps = np.flatnonzero(fast & (np.abs(step) > _WRAPS * spec.stroke))
        if len(jumps) < _AT_LEAST:
            continue
        size = float(np.median(np.abs(step[jumps])))
        places = np.maximum(q[jumps, joint], q[jumps + 1, joint])
        alike = np.abs(np.abs(step[jumps]) - size) < 0.05 * size
        if alike.mean() < 0.9 or np.ptp(np.quantile(places, [0.1, 0.9])) > 0.1 * size:
            continue
        turns = np.zeros(len(q))
        turns[jumps + 1] = -np.sign(step[jumps])
        turns[:] = np.cumsum(turns)
        q[:, joint] += size * (turns - turns.min())
        joints.append(joint)
        sizes.append(size)
        spans += [(float(states.t[i]), float(states.t[i + 1])) for i in jumps]
        times = max(times, len(jumps))
        at = float(np.median(places))
    if not joints:
        return None
    text = (
        f"q{joints_in_words(view, joints)} wraps around: at {at:.2f} {recording.unit} it jumps by "
        f"{np.median(sizes):.2f} {recording.unit}, {times} times"
    )
    return Fault("wraps", text, tuple(sorted(spans)), replace(states, q=q))


def _old_values(view: SideView) -> Fault | None:
    """States with exactly the values of an earlier one, between new ones."""
    states = view.states
    values = np.nan_to_num(np.hstack((states.q, states.dq, states.tau)))
    newest: dict[bytes, int] = {}
    old = np.zeros(len(states), dtype=np.bool_)
    ages = []
    for row, value in enumerate(values + 0.0):  # -0.0 is 0.0
        key = value.tobytes()
        before = newest.get(key, row)
        if before < row - 2:
            old[row] = True
            ages.append(float(states.t[row] - states.t[before]))
        else:
            newest[key] = row
    if len(ages) < _AT_LEAST:
        return None
    age, (low, high) = float(np.median(ages)), np.percentile(ages, [20, 80])
    if age > _AWAY_S or high - low > 0.3 * age:
        return None
    text = f"{len(ages)} of {len(states)} states have the values of {_ms(age)} before"
    return Fault("old", text, _spans(states, _runs(old)), _bridged(states, old))


def _jumps_and_returns(recording: Recording, view: SideView) -> Fault | None:
    """States whose q leaves the course of the others by a jump, and comes back by another."""
    states = view.states
    away = np.zeros(states.q.shape, dtype=np.bool_)
    for joint, spec in enumerate(view.joints):
        for begin, end in _excursions(states.t, states.q[:, joint], spec.stroke):
            away[begin:end, joint] = True
    runs = _runs(np.asarray(away.any(axis=1)))
    if not runs:
        return None
    far = max(float(np.abs(states.q[a] - states.q[a - 1]).max()) for a, _ in runs)
    of = joints_in_words(view, np.flatnonzero(away.any(axis=0)))
    text = (
        f"q{of} jumps away and back, by up to {far:.2g} "
        f"{recording.unit}, in {_counted(states, runs)}"
    )
    if _are_of_other_hand(recording, view, [a for a, _ in runs]):
        text += ", with the other hand's values"
    return Fault("away", text, _spans(states, runs), _bridged(states, away))


def _excursions(t: Floats, q: Floats, stroke: float) -> Iterator[Run]:
    step = np.diff(q)
    least = np.maximum(_LEAST_JUMP, _FASTEST * np.minimum(np.diff(t), 0.01)) * stroke
    jumps = np.flatnonzero(np.abs(step) > least)
    back = -1
    for at, i in enumerate(jumps.tolist()):
        if i <= back:
            continue
        for j in jumps[at + 1 : at + 4].tolist():
            opposite = step[i] * step[j] < 0
            if opposite and abs(step[i] + step[j]) < _SAME_JUMP * abs(step[i]):
                if t[j] - t[i] <= _AWAY_S:
                    yield i + 1, j + 1
                    back = j
                break


def _are_of_other_hand(recording: Recording, view: SideView, rows: Sequence[int]) -> bool:
    """Whether these states have the values that the other hand has then, and this one not."""
    states = view.states
    others = [v.states for side, v in recording.sides.items() if side is not view.side]
    if not others or len(others[0]) < _FEWEST:
        return False
    apart = []
    for row in rows:
        begin, end = np.searchsorted(others[0].t, states.t[row] + np.array([-0.1, 0.1]))
        theirs = np.median(others[0].q[begin : end + 1], axis=0)
        apart.append([np.abs(theirs - states.q[i]).max() for i in (row, row - 1)])
    inside, before = np.median(np.array(apart), axis=0)
    return bool(inside < 0.1 * before)


def _frozen_joints(view: SideView) -> Fault | None:
    """Joints whose q stays equal again and again, and then jumps to where the joint is."""
    states = view.states
    found: dict[int, list[Run]] = {}
    usual: dict[int, float] = {}
    for joint, spec in enumerate(view.joints):
        q = states.q[:, joint]
        changes = np.flatnonzero(np.diff(q) != 0) + 1
        if len(changes) < _FEWEST:
            continue
        step = np.abs(q[changes] - q[changes - 1])
        held = np.diff(states.t[changes])
        frozen = (held >= _HELD_S[0]) & (np.diff(changes) >= _HELD_STATES)
        frozen &= step[1:] > max(3 * float(np.percentile(step, 90)), 0.004 * spec.stroke)
        moving = frozen & (held < _HELD_S[1])
        if int(moving.sum()) < _AT_LEAST:
            continue
        usual[joint] = float(np.median(held[moving]))
        ends = changes[1:][frozen]
        # where the joint rested before, it froze in the end
        begins = np.searchsorted(states.t, states.t[ends] - usual[joint])
        begins = np.where(moving[frozen], changes[:-1][frozen], begins)
        found[joint] = list(zip(begins.tolist(), ends.tolist(), strict=True))
    if not found:
        return None
    worst = max(found, key=lambda joint: len(found[joint]))
    held_s = usual[worst]
    wrong = np.zeros(states.q.shape, dtype=np.bool_)
    for joint, runs in found.items():
        for begin, end in runs:
            wrong[begin + 1 : end, joint] = True
    text = (
        f"q{joints_in_words(view, sorted(found))} stays the same for {_ms(held_s)} (median) "
        f"while the joint moves, and then jumps, {len(found[worst])} times"
    )
    return Fault("frozen", text, _spans(states, found[worst]), _bridged(states, wrong))


def _bridged(states: States, wrong: Flags) -> States:
    """The states with the wrong ones interpolated between those around them.

    :param wrong: of each state, or of each state and joint.
    """
    if wrong.ndim == 1:
        wrong = np.broadcast_to(wrong[:, np.newaxis], states.q.shape)

    def bridge(values: Floats) -> Floats:
        values = values.copy()
        for joint in np.flatnonzero(wrong.any(axis=0) & ~wrong.all(axis=0)):
            bad = wrong[:, joint]
            values[bad, joint] = np.interp(states.t[bad], states.t[~bad], values[~bad, joint])
        return values

    states = replace(states, q=bridge(states.q), ddq=bridge(states.ddq), tau=bridge(states.tau))
    return replace(states, dq=np.where(wrong, _slope(states), states.dq))


# -------------------------------------------------------------------------------- all states


def _wrong_velocity(view: SideView) -> Fault | None:
    """A dq that is another multiple of the slope of q than 1, or 0, or nothing of the kind."""
    states = view.states
    slope = _slope(states)
    found: dict[str, list[int]] = {}
    for joint, spec in enumerate(view.joints):
        x, y = slope[:, joint], states.dq[:, joint]
        moving = np.isfinite(x) & np.isfinite(y) & (np.abs(x) > _MOVING * spec.stroke)
        if int(moving.sum()) < _FEWEST:
            continue
        x, y = x[moving], y[moving]
        if not y.any():
            found.setdefault("0 while q moves", []).append(joint)
            continue
        product, size = float((x * y).sum()), float((x**2).sum())
        alike, factor = product / np.sqrt(size * float((y**2).sum())), product / size
        if abs(alike) < _ALIKE:
            found.setdefault("not the slope of q", []).append(joint)
        elif not _TRUE[0] < factor < _TRUE[1]:
            found.setdefault(f"{factor:.2g} times the slope of q", []).append(joint)
    if not found:
        return None
    what = max(found, key=lambda text: len(found[text]))
    wrong = sorted(joint for joints in found.values() for joint in joints)
    dq = states.dq.copy()
    dq[:, wrong] = slope[:, wrong]
    return Fault("dq", f"dq{joints_in_words(view, wrong)} is {what}", (), replace(states, dq=dq))


def _slope(states: States) -> Floats:
    """The slope of q about each state."""
    t = states.t
    first = np.searchsorted(t, t - _SLOPE_S / 2)
    last = np.minimum(np.searchsorted(t, t + _SLOPE_S / 2), len(t) - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (states.q[last] - states.q[first]) / (t[last] - t[first])[:, np.newaxis]
    return np.asarray(np.nan_to_num(found, posinf=0.0, neginf=0.0))


# -------------------------------------------------------------------------------------- words


def _runs(flags: Flags) -> list[Run]:
    """The stretches of states with a flag."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return [(a, b) for a, b in edges.reshape(-1, 2).tolist()]


def _flags(states: States, runs: Iterable[Run]) -> Flags:
    found = np.zeros(len(states), dtype=np.bool_)
    for begin, end in runs:
        found[begin:end] = True
    return found


def _counted(states: States, runs: Sequence[Run]) -> str:
    """``44 single states``, or ``264 states, 44 times for 12 ms``."""
    count = sum(end - begin for begin, end in runs)
    if count == len(runs):
        return f"{count} single state{'s' if count > 1 else ''}"
    lasts = float(np.median([b - a for a, b in _spans(states, runs)]))
    often = f"{len(runs)} times" if len(runs) > 1 else "once"
    return f"{count} states, {often} for {_ms(lasts)}"


def _spans(states: States, runs: Iterable[Run]) -> tuple[Span, ...]:
    last = len(states) - 1
    return tuple((float(states.t[a]), float(states.t[min(b, last)])) for a, b in runs)


def joints_in_words(view: SideView, joints: Iterable[int]) -> str:
    """Whose values they are, where there are several joints."""
    names = [view.joints[int(joint)].name for joint in joints]
    if len(view.joints) == 1:
        return ""
    if len(names) == len(view.joints):
        return " of all joints"
    return f" of {', '.join(names[:3])}{' and others' if len(names) > 3 else ''}"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.2f} s"
