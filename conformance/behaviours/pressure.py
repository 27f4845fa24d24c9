"""Pressures that fingers and palm measure.

What counts is the change of an element from what it read before the contact: a hand's values are
absolute, and a touch may lower them (docs/sources/real-hands.md#touch-sign). Before the contact is
known here, from the phases of the run; tools that do not know it use :mod:`dexkit.pressure`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.behaviours.grip import finger_squeezes
from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of
from dexkit.conformance.checks.figures import Figure, Figures, with_object, worst
from dexkit.conformance.checks.steps import steps_of
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.fingers import BEYOND, FingerScript
from dexkit.conformance.stimuli.phases import stimulus
from dexkit.conformance.stimuli.script import Steps
from dexkit.hand import Floats, Side, Subject
from dexkit.models import HandModel
from dexkit.pressure import NO_VALUE, known

_SOFT_HOLD, _SOFT_HOLD_SECONDS, _FIRM_SECONDS = 0.5, 0.3, 0.12
"""A soft hold: its stiffness as a part of the client's, and seconds; seconds of a firm one."""
_RAMP, _RAMP_SECONDS = 10, 0.2
"""Steps in which a soft hold becomes a firm one, and seconds for all of them."""


@stimulus("firmer", FingerScript, after="touch")
def press_firmer(script: FingerScript) -> Steps:
    """All fingers hold the object softly; each presses firmly in turn, and softly again."""
    pressing = script.plan.pressing
    if not pressing:
        return
    script.report("holding the object softly, with one finger after the other firmly")
    firm = finger_squeezes(script, pressing, {})
    soft: dict[Side, Motors] = {}
    for s in pressing:
        near = script.pose(s, script.plan.objects[s] + BEYOND)
        soft[s] = [
            replace(m, q=near[i], kp=_SOFT_HOLD * m.kp) if script.joints[s][i].closing else m
            for i, m in enumerate(firm[s])
        ]
    yield from script.hold(_SOFT_HOLD_SECONDS, soft)
    fingers = dict.fromkeys(j.name.partition("_")[0] for j in script.joints[pressing[0]])
    before = soft
    for finger in (*fingers, ""):  # in the end all softly again
        hands: dict[Side, Motors] = {
            s: [
                firm[s][i] if finger and script.joints[s][i].name.startswith(finger) else m
                for i, m in enumerate(soft[s])
            ]
            for s in pressing
        }
        phase = script.begin("firmer", pressing, finger=finger)
        # slowly: what is seen must not be seen by the motion that a step makes
        for i in range(1, _RAMP + 1):
            between = {s: _between(before[s], hands[s], i / _RAMP) for s in pressing}
            yield from script.hold(_RAMP_SECONDS / _RAMP, between)
        yield from script.hold(_FIRM_SECONDS, hands)
        script.end(phase)
        before = hands


def _between(a: Motors, b: Motors, part: float) -> list[Motor]:
    """Commands on the way from one hand's to another's."""
    return [
        replace(n, q=m.q + part * (n.q - m.q), kp=m.kp + part * (n.kp - m.kp))
        for m, n in zip(a, b, strict=True)
    ]


_SLOTS = 12  # of a PressSensorState_


def _packets(ctx: Context) -> NDArray[np.intp]:
    assert ctx.states.columns is not None
    count = ctx.states.columns.count("press_sensor_state")
    return count[count >= 0]


def _pressure(ctx: Context, packet: int, rows: slice = slice(None)) -> Floats:
    """A packet's pressures, shape (n, 12)."""
    assert ctx.states.columns is not None
    return ctx.states.columns[f"press_sensor_state[{packet}].pressure"][rows]


@check("DEX3-SENS-01", rests_on=("pressure",))
def packets(ctx: Context) -> Outcome:
    """The number of sensor packets, their values, and which slots hold one."""
    parts = [_count(ctx), _numbers(ctx)]
    return all_of(*parts, _same_slots(ctx)) if ctx.phases("squeeze") else all_of(*parts)


def _count(ctx: Context) -> Outcome:
    """Number of sensor packets."""
    found = np.unique(_packets(ctx))
    most = ctx.tolerance("max_packets")
    seen = " or ".join(str(n) for n in found)
    if len(found) == 1 and found[0] <= most:
        return ctx.passed(seen, f"{seen} sensor packets in each state")
    outcome = ctx.failed(seen, f"{seen} sensor packets, from state to state")
    if len(found) == 1:
        return outcome.because("Each sensor element is published as a separate packet.")
    return outcome.because("A packet is published only when its sensor has a new value.")


def _numbers(ctx: Context) -> Outcome:
    """Every pressure is a number that is not negative."""
    count = int(_packets(ctx).max(initial=0))
    if not count:
        return ctx.skipped("the states hold no sensor packets")
    assert ctx.states.columns is not None
    have = ctx.states.columns.count("press_sensor_state")
    for packet in range(count):
        low, high = ctx.states.columns.extremes(f"press_sensor_state[{packet}].pressure")
        if low >= 0 and high < np.inf:
            continue
        values = _pressure(ctx, packet)
        good = (np.isfinite(values) & (values >= 0)).all(axis=1) | (have <= packet)
        if not good.all():
            i = int(np.argmin(good))
            slot = int(np.argmin(np.isfinite(values[i]) & (values[i] >= 0)))
            return ctx.failed(
                f"{values[i, slot]}",
                f"pressure {values[i, slot]} in slot {slot} of packet {packet}",
                ctx.at(ctx.states.topic, float(ctx.states.t[i])),
            )
    return ctx.passed("all finite", f"{count} packets of {_SLOTS}")


def _same_slots(ctx: Context) -> Outcome:
    """Whether a slot that held a value becomes a slot without a sensor, or the other way round."""
    columns = ctx.states.columns
    assert columns is not None
    count = columns.count("press_sensor_state")
    full = count == count.max(initial=0)
    for packet in range(int(count.max(initial=0))):
        marked = columns[f"press_sensor_state[{packet}].pressure"][full] == NO_VALUE
        changes = (marked != marked[:1]).any(axis=1)
        if changes.any():
            at = float(ctx.states.t[full][int(np.argmax(changes))])
            return ctx.failed(
                "changes",
                f"at {at:.2f} s an element of packet {packet} begins or ends to hold "
                f"{NO_VALUE:g}, which means that there is no sensor",
                ctx.at(ctx.states.topic, at),
            )
    return ctx.passed("constant", "the same slots hold a value throughout")


@check("DEX3-SENS-03")
def no_value(ctx: Context) -> Outcome:
    """Nine packets; 33 elements, and the code for "no sensor here" elsewhere, always the same."""
    count = int(_packets(ctx).max(initial=0))
    if not count:
        return ctx.absent("the states hold no sensor packets")
    code = ctx.tolerance("no_value")
    if count != ctx.tolerance("packets"):
        return ctx.failed(f"{count} packets", f"{count} sensor packets in a state")
    marked = [_pressure(ctx, packet) == code for packet in range(count)]
    elements = count * _SLOTS - sum(int(m[0].sum()) for m in marked)
    changes = sum(int((m != m[0]).any()) for m in marked)
    if changes:
        return ctx.failed("changes", f"the slots without a value change in {changes} packets")
    text = f"{elements} of {count * _SLOTS} slots hold a value, the others {code:g}"
    if elements == ctx.tolerance("elements"):
        return ctx.passed(f"{elements} elements", text)
    outcome = ctx.failed(f"{elements} elements", text)
    if elements == count * _SLOTS:
        return outcome.because("No slot is marked: those without a sensor hold a number, too.")
    return outcome


_BEFORE_S = 0.1  # s before a phase or at its end in which a pressure is taken


_REST_S = 0.5  # s before a contact in which the noise is taken


_STANDS = 0.02  # of the stroke: motion at the end of a phase that still counts as standing


def _pressures(
    ctx: Context, begin: float, end: float, side: Subject | None = None
) -> Floats | None:
    """The median pressure in each slot, shape (n_packets, 12); NaN for no value; None if there are
    no packets. Of tactile areas likewise, in their order.

    :param side: None for the side to be judged.
    """
    if ctx.recording.dialect.touch_topic:
        touch = ctx.recording.touch.get(ctx.side if side is None else side)
        return None if touch is None else touch.median(begin, end)
    found = _readings(ctx, begin, end, side)
    return None if found is None else np.asarray(np.median(found, axis=0))


def _noise(ctx: Context, end: float) -> float:
    """The most that an element varies in the time before ``end``, in which nothing touches it."""
    if ctx.recording.dialect.touch_topic:
        return 0.0  # counts, which are 0 at rest
    found = _readings(ctx, end - _REST_S, end)
    return 0.0 if found is None else float(np.nanmax(np.ptp(found, axis=0), initial=0.0))


def _changes(after: Floats, before: Floats) -> Floats:
    """The size of the change of each element; 0 for those without a value."""
    return np.asarray(np.nan_to_num(np.abs(after - before)))


def _readings(ctx: Context, begin: float, end: float, side: Subject | None = None) -> Floats | None:
    """The pressures of every state, shape (n, n_packets, 12), NaN for no value; None if there are
    none.
    """
    hand = ctx.hand if side is None else ctx.recording.sides[side]
    states, columns = hand.states, hand.states.columns
    rows = states.between(begin, end)
    if columns is None or not len(states.t[rows]):
        return None
    count = columns.count("press_sensor_state")[rows]
    least = int(count.min(initial=99))
    if not 0 < least < 99:
        return None
    packets = hand.known.setdefault("pressures", {})  # decoded once: there are many phases
    for i in range(least):
        if i not in packets:
            packets[i] = columns[f"press_sensor_state[{i}].pressure"]
    return known(np.stack([packets[i][rows] for i in range(least)], axis=1))


def _finger_packets(ctx: Context, finger: str) -> list[int]:
    """The packets of a finger's sensors, or its areas."""
    return [i for i, place in enumerate(_places(ctx)) if place.partition(" ")[0] == finger]


def _places(ctx: Context) -> list[str]:
    """Where the packets or areas are."""
    hand = ctx.recording.model
    assert isinstance(hand, HandModel)  # a robot has no fingers
    return [one.place for one in hand.sensors or ctx.recording.dialect.areas]


def _fingers(ctx: Context) -> tuple[str, ...]:
    """The fingers with sensors; the palm is none."""
    names = {j.name.partition("_")[0] for j in ctx.joints}
    places = (place.partition(" ")[0] for place in _places(ctx))
    return tuple(dict.fromkeys(p for p in places if p in names))


def _touches(ctx: Context) -> Iterator[tuple[Phase, str, Floats, Floats]]:
    """Phases in which a finger presses, with the finger and the pressures before and during the
    phase.
    """
    for phase in ctx.phases("touch"):
        begin, end = ctx.span(phase)
        free = _pressures(ctx, begin - _BEFORE_S, begin)
        held = _pressures(ctx, end - _BEFORE_S, end)
        if free is not None and held is not None:
            yield phase, phase.params.get("finger", ""), free, held


def _presses(ctx: Context, phase: Phase) -> bool:
    """Whether the object stops the finger: by q, it stands still before its goal."""
    return any(
        s.error > ctx.requirement.tolerance("min_held_stroke") * s.stroke
        and float(np.ptp(s.q[s.t >= s.end - _BEFORE_S])) < _STANDS * s.stroke
        for s in steps_of(ctx, phase)
        if (s.t >= s.end - _BEFORE_S).any()
    )


@check("DEX3-SENS-04")
@with_object
def touch(ctx: Context) -> Outcome:
    """The change of the pressure in a finger's own packets while it alone presses."""
    found = list(_touches(ctx))
    if not found:
        return ctx.absent("the states hold no sensor packets")
    rest, noise = found[0][2], _noise(ctx, ctx.span(found[0][0])[0])
    judged = 0
    for phase, finger, free, held in found:
        mine = [i for i in _finger_packets(ctx, finger) if i < len(held)]
        if not mine or not _presses(ctx, phase):
            continue
        judged += 1
        changes = _changes(held, free)
        own = float(changes[mine].max(initial=0.0))
        # the finger before is let go of in this phase, and its pressure goes back to rest
        grown = _changes(held, rest) - _changes(free, rest)
        foreign = max(
            (
                float(grown[i].max(initial=0.0))
                for name in _fingers(ctx)
                if name != finger
                for i in _finger_packets(ctx, name)
                if i < len(grown)
            ),
            default=0.0,
        )
        if own > max(foreign, noise) or np.isnan((held - free)[mine]).all():
            continue
        others = [i for i in range(len(changes)) if changes[i].max(initial=0.0) > noise]
        outcome = ctx.failed(
            "other packets" if others else "no touch",
            f"the {finger} presses on the object, and the pressure changes in "
            + (f"packets {others}, and not most in its own ({mine})" if others else "no packet"),
            ctx.at(ctx.states.topic, *ctx.span(phase)),
        )
        return outcome
    if not judged:
        return ctx.skipped("the object held no finger back")
    return ctx.passed(
        f"{judged} fingers",
        f"{judged} fingers report pressure at the object, each by its own sensors",
    )


@check("DEX3-SENS-08")
@with_object
def follows_the_grip(ctx: Context) -> Outcome:
    """The pressure in a grip, where its force changes, and after it."""
    return all_of(_lasts(ctx), _follows_the_force(ctx), _releases(ctx))


def _releases(ctx: Context) -> Outcome:
    """Remaining pressure of each element some time after the object was released."""
    rest = [ctx.span(p)[0] for p in (ctx.phases("touch") or ctx.phases("squeeze"))[:1]]
    held = [ctx.span(p) for p in ctx.phases("squeeze")]
    let_go = [ctx.span(p)[0] for p in ctx.phases(ctx.requirement.phases[-1])]
    if not rest or not held or not let_go:
        return ctx.skipped("the hand held no object")
    free = _pressures(ctx, rest[0] - 2 * _BEFORE_S, rest[0])
    most = _pressures(ctx, held[0][1] - 2 * _BEFORE_S, held[0][1])
    at = let_go[0] + ctx.tolerance("release_s")
    later = _pressures(ctx, at, at + _BEFORE_S)
    if free is None or most is None or later is None:
        return ctx.absent("the states hold no sensor packets")
    change, left = _changes(most, free), _changes(later, free)
    # noise of an element with hardly any contact does not count
    least = ctx.tolerance("min_rise_part") * change.max(initial=0.0)
    touched = change > max(least, _noise(ctx, rest[0]))
    if not touched.any():
        return ctx.skipped("no pressure changed at the object")
    part = np.where(touched, left / np.where(touched, change, 1.0), 0.0)
    packet, slot = (int(i) for i in np.unravel_index(int(np.argmax(part)), part.shape))
    worst = float(part[packet, slot])
    text = (
        f"{worst:.0%} of the change of pressure in slot {slot} of packet {packet} is left "
        f"{ctx.tolerance('release_s'):g} s after the release"
    )
    if worst <= ctx.tolerance("max_part"):
        return ctx.passed(f"{worst:.0%}", text, left_part=worst)
    return ctx.failed(f"{worst:.0%}", text, ctx.at(ctx.states.topic, at), left_part=worst)


def _untouched(ctx: Context, begin: float) -> float:
    """Time at which the hand touched the object that it grips at ``begin``, s."""
    before = [ctx.span(p)[0] for name in ("touch", "firmer") for p in ctx.phases(name)]
    return min((b for b in before if b < begin), default=begin)


@worst("kept_part", "min_part", nothing="no pressure changed at the object")
def _lasts(ctx: Context) -> Figures:
    """The smallest remaining part of an element's pressure at the end of a grip."""
    for phase in ctx.phases("squeeze"):
        begin, end = ctx.span(phase)
        if end - begin < ctx.tolerance("min_hold_s"):
            continue
        rest = _untouched(ctx, begin)
        free = _pressures(ctx, rest - 2 * _BEFORE_S, rest)
        first = _pressures(ctx, begin + 0.5, begin + 0.5 + _BEFORE_S)
        last = _pressures(ctx, end - _BEFORE_S, end)
        if free is None or first is None or last is None:
            continue
        change = _changes(first, free)
        later = np.nan_to_num(last - free) * np.sign(np.nan_to_num(first - free))
        most = float(change.max(initial=0.0))
        if most <= _noise(ctx, rest):
            continue
        part = np.where(change >= 0.3 * most, later / np.where(change > 0, change, 1.0), np.inf)
        packet, slot = (int(k) for k in np.unravel_index(int(np.argmin(part)), part.shape))
        left = max(float(part[packet, slot]), 0.0)
        text = (
            f"at the end of a grip of {end - begin:.1f} s, {left:.0%} of the change of pressure is "
            f"left in slot {slot} of packet {packet}"
        )
        yield Figure(left, begin, end, text=text)


@worst(
    "followed_part",
    "min_follow_part",
    nothing="no finger's torque changed while it held the object",
)
def _follows_the_force(ctx: Context) -> Figures:
    """Change of a finger's pressure relative to that of its torque, while it holds the object.

    Gear friction keeps the pressure, so a rise counts only above the largest torque of the grip so
    far, and a fall only where the finger gives way by a part of its former advance.
    """
    phases = sorted(ctx.phases("firmer"), key=lambda p: p.begin_ns)
    if not phases:
        yield ctx.skipped("the fingers did not press in turn")
    rest = _untouched(ctx, ctx.span(phases[0])[0])
    free, noise = _pressures(ctx, rest - 2 * _BEFORE_S, rest), _noise(ctx, rest)
    for phase, after in zip(phases, [*phases[1:], None], strict=True):
        finger = phase.params.get("finger", "")
        begin, end = ctx.span(phase)
        later = end if after is None else ctx.span(after)[1]
        if not finger:  # they are all soft again
            continue
        for word, limit, a, b in (
            ("rises", "min_follow_part", begin, end),
            ("falls", "min_fall_part", end, later),
        ):
            if word == "falls" and not _gives_way(ctx, finger, begin, end, later):
                continue
            share = _share(ctx, finger, free, noise, a, b)
            if share is not None:
                text = f"where the torque of the {finger} {word} on the object, its pressure shows "
                text += f"{share:.0%} of that"
                yield Figure(share, a, b, text=text, limit=ctx.tolerance(limit))


def _share(
    ctx: Context, finger: str, free: Floats | None, noise: float, begin: float, end: float
) -> float | None:
    """The change of a finger's pressure from before ``begin`` to ``end``, relative to the change
    that its torque predicts; None where the torque hardly changes.
    """
    joints = [i for i, j in enumerate(ctx.joints) if j.closing and j.name.startswith(finger)]
    before, then = (
        ctx.states.between(begin - _BEFORE_S, begin),
        ctx.states.between(end - _BEFORE_S, end),
    )
    was, now = _pressures(ctx, begin - _BEFORE_S, begin), _pressures(ctx, end - _BEFORE_S, end)
    mine = _finger_packets(ctx, finger)
    if free is None or was is None or now is None or not joints or max(mine) >= len(now):
        return None
    had, has = (np.abs(np.median(ctx.states.tau[r][:, joints], axis=0)) for r in (before, then))
    if end - begin < _BEFORE_S or had.min() < ctx.tolerance("min_tau_nm"):
        return None
    rises = bool(has.sum() > had.sum())
    part = float((has / had).max() if rises else (has / had).min()) - 1.0
    if abs(part) < ctx.tolerance("min_change_part"):
        return None
    if rises:
        part = min(part, float((has / _most_torque(ctx, joints, begin)).max()) - 1.0)
        if part < ctx.tolerance("min_change_part"):
            return None
    felt, feels = _changes(was, free)[mine], _changes(now, free)[mine]
    most = float(max(felt.max(initial=0.0), feels.max(initial=0.0)))
    touched = np.maximum(felt, feels) >= ctx.tolerance("min_touched_part") * most
    if most <= noise:
        return 0.0
    changed = (feels[touched] - felt[touched]) / np.maximum(felt[touched], 1e-3 * most)
    return float((changed / part).max())


def _most_torque(ctx: Context, joints: list[int], begin: float) -> Floats:
    """The largest torque of each joint in the grip in progress at ``begin``, N m, shape
    (joints,).
    """
    tau = np.abs(ctx.tau(0.0, begin)[:, joints])
    free = np.flatnonzero((tau < ctx.tolerance("min_tau_nm")).all(axis=1))
    return np.asarray(tau[free[-1] + 1 if len(free) else 0 :].max(axis=0))


def _gives_way(ctx: Context, finger: str, begin: float, end: float, later: float) -> bool:
    """Whether a joint that advanced into the object from ``begin`` to ``end`` returns by a part of
    that until ``later``.
    """
    joints = [i for i, j in enumerate(ctx.joints) if j.closing and j.name.startswith(finger)]
    way = np.array([ctx.joints[i].closing / ctx.joints[i].stroke for i in joints])
    rows = [ctx.states.between(t - _BEFORE_S, t) for t in (begin, end, later)]
    if not all(len(ctx.states.t[r]) for r in rows):
        return False
    soft, firm, again = (np.median(ctx.states.q[r][:, joints], axis=0) * way for r in rows)
    least = np.maximum(
        ctx.tolerance("min_way_stroke"), ctx.tolerance("min_fall_part") * (firm - soft)
    )
    return bool((firm - again >= least).any())


@check("DEX3-SENS-11", rests_on=("pressure",))
def feels_nothing(ctx: Context) -> Outcome:
    """The change of pressures in a standing hand without contact, while the other hand squeezes an
    object.
    """
    if ctx.object_at is not None:
        return ctx.skipped("this hand has an object itself")
    other = [s for s in ctx.recording.judged if s != ctx.side]
    squeezes = [p for s in other for p in ctx.recording.phases("squeeze", s)]
    touches = [p for s in other for p in ctx.recording.phases("touch", s)]
    if not squeezes:
        return ctx.skipped("no other hand squeezes an object")
    (side,) = other
    rest, end = ctx.span((touches or squeezes)[0])[0], ctx.span(squeezes[0])[1]
    spans = ((rest - 2 * _BEFORE_S, rest), (end - 2 * _BEFORE_S, end))
    mine = [_pressures(ctx, *span) for span in spans]
    theirs = [_pressures(ctx, *span, side=side) for span in spans]
    if mine[0] is None or mine[1] is None or theirs[0] is None or theirs[1] is None:
        return ctx.absent("the states hold no sensor packets")
    change = _changes(mine[1], mine[0])
    pressed = float(_changes(theirs[1], theirs[0]).max(initial=0.0))
    noise = _noise(ctx, rest)
    if pressed <= noise:
        return ctx.skipped(f"the {side} hand felt no object")
    packet, slot = (int(k) for k in np.unravel_index(int(np.argmax(change)), change.shape))
    part = max(float(change[packet, slot]) - noise, 0.0) / pressed
    text = (
        f"while the {side} hand squeezes an object, the pressure in slot {slot} of packet {packet} "
        f"of this one changes by {part:.0%} of the most there"
    )
    if part <= ctx.tolerance("max_part"):
        return ctx.passed(f"{part:.0%}", text, part=part)
    return ctx.failed(f"{part:.0%}", text, ctx.at(ctx.states.topic, *spans[1]), part=part)
