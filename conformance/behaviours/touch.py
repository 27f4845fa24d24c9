"""The topic of an Inspire FTP's tactile areas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dexkit.conformance.checks import Context, Late, Outcome, check, rate_measure
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, judged, with_object
from dexkit.conformance.checks.stands import FEW_STANDS, stands
from dexkit.conformance.checks.timing import gap_beside_states
from dexkit.conformance.kit.motor_messages import Motors
from dexkit.conformance.kit.provenance import TIMES
from dexkit.conformance.kit.touch import Touch
from dexkit.conformance.stimuli.fingers import BEYOND, FingerScript
from dexkit.conformance.stimuli.phases import stimulus
from dexkit.conformance.stimuli.script import Steps
from dexkit.hand import Floats, Side

_TOUCH_SECONDS = 0.22
"""Seconds in which a finger presses on the object alone."""
_TOUCH_STANDS, _TOUCH_MORE = 0.1, 12
"""Seconds in which it stands then, and how often it is waited for that."""


@stimulus("touch", FingerScript, after="late-joiner")
def touch_object(script: FingerScript) -> Steps:
    """One finger after the other presses on the object."""
    pressing = script.plan.pressing
    if not pressing:
        return
    script.report("touching the object with one finger after the other")
    for finger in dict.fromkeys(j.name.partition("_")[0] for j in script.joints[pressing[0]]):
        targets: dict[Side, dict[int, float]] = {}
        hands: dict[Side, Motors] = {}
        for s in pressing:
            far = script.pose(s, script.plan.objects[s] + BEYOND)
            targets[s] = {
                i: far[i]
                for i, j in enumerate(script.joints[s])
                if j.closing and j.name.startswith(finger)
            }
            pose = [targets[s].get(i, q) for i, q in enumerate(script.home(s))]
            hands[s] = script.motors(s, tuple(pose))
        phase = script.begin("touch", pressing, targets=targets, finger=finger)
        yield from script.hold(_TOUCH_SECONDS + _travel(script, targets), hands)
        # a slow finger is still on its way
        for _ in range(_TOUCH_MORE):
            before = {s: script.obs.q.get(s, script.home(s)) for s in pressing}
            yield from script.hold(_TOUCH_STANDS, hands)
            if all(script.near(s, before[s], script.obs.q.get(s, before[s])) for s in pressing):
                break
        script.end(phase)


def _travel(script: FingerScript, targets: Mapping[Side, Mapping[int, float]]) -> float:
    """Seconds that position servos need from home; others are there at once."""
    if not script.plan.dialect.position_servo:
        return 0.0
    return max(
        abs(q - script.home(s)[i]) / script.joints[s][i].dq_max
        for s, mine in targets.items()
        for i, q in mine.items()
    )


_WINDOW_S = 1.0


_NOTHING = "nothing was received on the touch topic"


def _touch(ctx: Context) -> Touch | None:
    found = ctx.recording.touch.get(ctx.side)
    return found if found is not None and len(found) else None


@check("FTP-TOUCH-01", rests_on=("pressure",))
def touch_messages(ctx: Context) -> Outcome:
    """Whether each area always has as many elements as its matrix, where there are any."""
    touch = _touch(ctx)
    if touch is None:
        return _no_touch(ctx) if ctx.recording.endpoints else ctx.absent(_NOTHING)
    want = np.array([area.elements for area in touch.areas])
    wrong = touch.lengths != want
    if not wrong.any():
        return ctx.passed(
            f"{len(want)} areas", f"{int(want.sum())} elements in each of {len(touch)}"
        )
    row = int(np.argmax(wrong.any(axis=1)))
    at = float(touch.t[row])
    if row in touch.columns.errors:
        text = f"a sample does not decode: {touch.columns.errors[row]}"
        return ctx.failed("undecodable", text, ctx.at(touch.topic, at))
    area = touch.areas[int(np.argmax(wrong[row]))]
    length = int(touch.lengths[row][int(np.argmax(wrong[row]))])
    count = int(wrong.any(axis=1).sum())
    return ctx.failed(
        f"{area.member} {length}",
        f"{area.member} has {length} elements, not {area.elements} ({area.rows} x {area.columns}), "
        f"in {count} of {len(touch)} samples",
        ctx.at(touch.topic, at),
    )


def _no_touch(ctx: Context) -> Outcome:
    """The warning of a hand without touch on its topic."""
    dialect = ctx.recording.dialect
    topic, kind = dialect.touch_topic_of(ctx.side), dialect.touch_type
    others = {
        *(e.type_name for e in ctx.recording.endpoints if e.topic == topic and e.kind == "writer"),
        *(c.type_name for c in ctx.recording.channels if c.topic == topic),
    }
    figure, text = "no topic", f"no process publishes {topic}"
    if kind in others:
        figure, text = "no samples", f"{topic} is announced, and nothing comes on it"
    elif others:
        figure, text = "other type", f"{topic} has {', '.join(sorted(others))}, not {kind}"
    return replace(ctx.failed(figure, text).tolerated(), absent=True)


@check("FTP-TOUCH-03", rests_on=("pressure", TIMES))
def touch_comes_often(ctx: Context) -> Outcome:
    """The longest time without touch, and its rate, while there were states."""
    return all_of(_goes_on(ctx), warning(_rate(ctx)))


def _goes_on(ctx: Context) -> Outcome:
    """The longest time without touch while there were states."""
    touch = _touch(ctx)
    if touch is None or not len(ctx.states):
        return ctx.absent(_NOTHING)
    gap, at = gap_beside_states(touch.t, ctx.states.t)
    text = f"nothing on {touch.topic} for {gap:.2f} s, while there were states"
    figure = Figure(gap, at, at + gap, text=text, topic=touch.topic)
    return judged(ctx, [figure], "gap_s", "max_gap_s", nothing="")


def _rate(ctx: Context) -> Outcome:
    """The rate of the touch topic in most seconds in which there were states."""
    touch = _touch(ctx)
    if touch is None or len(ctx.states) < 2:
        return ctx.absent(_NOTHING)
    begins = np.arange(touch.t[0], ctx.states.t[-1] - _WINDOW_S, _WINDOW_S)
    if len(begins) < 2:
        return ctx.skipped("the recording is too short to tell a rate")
    counts = [
        np.searchsorted(touch.t, b + _WINDOW_S) - np.searchsorted(touch.t, b)
        for b in begins.tolist()
    ]
    rate = float(np.median(counts)) / _WINDOW_S
    limit = ctx.tolerance("min_rate_hz")
    late = 1.0 / max(rate, 0.5) - 1.0 / limit
    figure = Figure(
        rate,
        float(begins[0]),
        text=f"{rate:.0f} Hz on {touch.topic} in most seconds",
        shown=f"{rate:.0f} Hz",
        late=Late((late,), "mean"),
        measure=rate_measure(rate, limit, len(begins) * _WINDOW_S),
        topic=touch.topic,
    )
    return judged(ctx, [figure], "rate_hz", "min_rate_hz", nothing="")


def _rises(ctx: Context, touch: Touch) -> dict[str, Floats]:
    """The largest rise of an element of each finger's areas in each message, counts, above what it
    was before the first command.
    """
    first = float(ctx.commands.t[0]) if len(ctx.commands) else float(touch.t[0])
    before = max(int(np.searchsorted(touch.t, first)), 1)
    rise = np.nan_to_num(touch.values - np.median(touch.values[:before], axis=0))
    fingers = dict.fromkeys(j.name.partition("_")[0] for j in ctx.joints)
    mine = {f: [i for i, a in enumerate(touch.areas) if a.place.startswith(f)] for f in fingers}
    return {f: rise[:, rows].max(axis=(1, 2)) for f, rows in mine.items() if rows}


@check("FTP-TOUCH-05")
@with_object
def touch_in_grips(ctx: Context) -> Outcome:
    """The touch of each finger in its grips, and where nothing touches it."""
    touch = _touch(ctx)
    if touch is None:
        return ctx.absent(_NOTHING)
    some = False
    for finger, rise in _rises(ctx, touch).items():
        joints = [i for i, j in enumerate(ctx.joints) if j.name.startswith(finger)]
        grips = [s for s in stands(ctx) if s.presses[joints].any()]
        for one in grips:
            last = int(np.searchsorted(touch.t, one.end)) - 1
            gap = one.end - float(touch.t[max(last, 0)])
            own = ctx.states.t[ctx.states.between(one.end - gap, one.end)]
            if gap > ctx.tolerance("max_gap_s") and len(own) > 5:
                text = f"no touch message for {gap:.2f} s while the {finger} grips"
                return ctx.failed(f"{gap:.1f} s", text, ctx.at(touch.topic, one.end - gap, one.end))
        held = [(_last(touch, rise, s.begin, s.end), s) for s in grips]
        most = max(
            (float(rise[i]) for _, s in held for i in _rows(touch, s.begin, s.end)), default=0
        )
        if most <= 0.0:
            continue
        some = True
        weak = [s for part, s in held if part < ctx.tolerance("min_part") * most]
        if len(weak) >= FEW_STANDS:
            text = f"of its touch in other grips hardly any is left while the {finger} grips"
            return ctx.failed("no touch", text, ctx.at(touch.topic, weak[0].begin, weak[-1].end))
        free = [s for s in stands(ctx) if s.free[joints].all()]
        ends = np.array([s.end for s in grips])
        kept = [
            s
            for s in free
            if not ((ends > s.begin - ctx.tolerance("release_s")) & (ends <= s.end)).any()
            and _last(touch, rise, s.begin, s.end) > ctx.tolerance("max_part") * most
        ]
        if len(kept) >= FEW_STANDS:
            text = f"the touch of a grip is there while nothing touches the {finger}"
            return ctx.failed("touch", text, ctx.at(touch.topic, kept[0].begin, kept[-1].end))
    if not some:
        return ctx.skipped("no finger's areas rose at the object")
    return ctx.passed("as gripped", "each finger's areas tell its grips")


def _rows(touch: Touch, begin: float, end: float) -> range:
    """The messages in [begin, end], and the last one before, if there is none in it."""
    first, last = np.searchsorted(touch.t, begin), np.searchsorted(touch.t, end, "right")
    return range(int(first) if first < last else max(int(first) - 1, 0), max(int(last), 1))


def _last(touch: Touch, rise: Floats, begin: float, end: float) -> float:
    """The last rise in [begin, end]."""
    return float(rise[_rows(touch, begin, end)[-1]])
