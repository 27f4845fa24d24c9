"""Joints stay where they are without a new command.

The whole run counts, not only the ends of steps. Stretches that other requirements judge (bad
commands, missing commands, commands without a position gain) are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.goals import OWN_RULE, Goals, goals_of
from dexkit.conformance.checks.silences import Silence, motions_in, roles_of, silences_of
from dexkit.conformance.checks.timing import encoder_step
from dexkit.hand import Floats


@check("DEX3-HOLD-01")
def holds(ctx: Context) -> Outcome:
    """Grip force and motion to a position go on after commands end, without protection."""
    outcomes = [_holds_in(ctx, silence) for silence in silences_of(ctx, "silence", "guard")]
    if not outcomes:
        return ctx.skipped("no pause of commands")
    failed = [o for o in outcomes if o.met is False]
    passed = [o for o in outcomes if o.met]
    return (failed or passed or outcomes)[0]


_AT_LAST = 1.0  # s at the end of a silence


_CREEPS = 1.5  # times the least speed of a judged motion: a slower joint may stop by its friction


_STOOD_S = 0.3  # s before the time-out in which a joint that goes on to its goal moves


def _holds_in(ctx: Context, silence: Silence) -> Outcome:
    if ctx.object_at is not None and silence.driven is None:
        return _grips_on(ctx, silence)
    late, end = silence.late, silence.end
    target = silence.driven.targets.get(ctx.side) if silence.driven is not None else None
    slow = [j for j in roles_of(ctx).slow if not silence.guarded[j]]
    if not target or not slow:
        return ctx.skipped("no joint was on its way when the commands stopped")
    # at the beginning and, in a long silence, also at its end
    least = ctx.requirement.tolerance("min_travel_stroke")
    spans = [(late, min(end, late + _AT_LAST), least)]
    judged = False
    if end - late > 2 * _AT_LAST:
        spans.append((end - _AT_LAST, end, 0.5 * least))  # it is closer to its goal by then
    for a, b, least in spans:
        rows = ctx.states.between(a, a + 0.05)
        if not len(ctx.states.q[rows]):
            return ctx.skipped("no state in the silence")
        here = np.median(ctx.states.q[rows], axis=0)
        moved = motions_in(ctx, slow, a, b)
        for i, joint in enumerate(slow):
            left = abs(target[joint] - float(here[joint])) / ctx.joints[joint].stroke
            if left < 4 * least:
                if a == late:
                    return ctx.skipped("the hand had arrived before the time-out")
                continue
            if _stood(ctx, joint, silence):
                continue  # friction stopped it, and not the time-out
            way = least * (b - a) / _AT_LAST
            if way * ctx.joints[joint].stroke < encoder_step(ctx, joint):
                continue  # steps of q as coarse as this show no motion in such a short time
            judged = True
            if not moved[i] >= way:
                return ctx.failed(
                    "stops",
                    ctx.named(f"stopped on its way {a - silence.last:.1f} s after the last", joint)
                    + " command",
                    ctx.at(ctx.states.topic, a, b),
                ).about(joint)
    if not judged:
        return ctx.skipped("no joint moved any more when the time-out had passed")
    return ctx.passed("goes on", "went on to its position after the time-out")


def _stood(ctx: Context, joint: int, silence: Silence) -> bool:
    """Whether a joint had come to rest, or nearly, before the time-out could stop it."""
    until = silence.last + 0.8 * ctx.requirement.tolerance("timeout_s")
    least = _CREEPS * ctx.requirement.tolerance("min_travel_stroke") * _STOOD_S / _AT_LAST
    return float(motions_in(ctx, [joint], until - _STOOD_S, until)[0]) < least


def _grips_on(ctx: Context, silence: Silence) -> Outcome:
    last, late, end = silence.last, silence.late, silence.end
    before = np.abs(ctx.tau(last - 0.2, last))
    spans = [(late, min(end, late + _AT_LAST)), (max(late, end - _AT_LAST), end)]
    later = [np.abs(ctx.tau(a, b)) for a, b in spans]
    if not len(before) or not all(map(len, later)):
        return ctx.skipped("no state in the silence")
    pressed = np.where(silence.guarded, 0.0, np.median(before, axis=0))
    pressing = np.flatnonzero(pressed >= ctx.tolerance("min_tau_nm"))
    if not len(pressing):
        return ctx.skipped("no joint without protection pressed when the commands stopped")
    still = np.min([np.median(tau, axis=0) for tau in later], axis=0)
    joint = int(pressing[np.argmin(still[pressing] / pressed[pressing])])
    text = ctx.named(
        f"pressed with {pressed[joint]:.2f} N m, and after the time-out with {still[joint]:.2f} "
        "N m",
        joint,
    )
    if still[joint] >= ctx.tolerance("min_tau_part") * pressed[joint]:
        return ctx.passed("grips on", text, tau_nm=float(still[joint]))
    place = ctx.at(ctx.states.topic, late, end)
    return ctx.failed("lets go", text, place, tau_nm=float(still[joint])).about(joint)


_AT_REST_S = 0.3  # s without motion after which a joint is at rest


_UNDRIVEN_S = 0.1  # the same before the first command


_AT_REST_PART = 0.01  # of the stroke by which q may vary meanwhile


def _excluded(ctx: Context) -> list[tuple[float, float]]:
    """Begin and end of the excluded stretches."""
    return [ctx.span(p) for name in OWN_RULE for p in ctx.recording.phases(name, ctx.side)]


@check("DEX1-STILL-01", "DEX3-STILL-01")
@worst(
    "motion_rad",
    "max_motion_stroke",
    nothing="no joint came to rest while its command stayed the same",
)
def still(ctx: Context) -> Figures:
    """The largest motion of a joint at rest with a constant goal."""
    if not len(ctx.commands):
        yield ctx.skipped("no commands to this hand in the recording")
    excluded = _excluded(ctx)
    for joint in range(len(ctx.joints)):
        for begin, end, goal in _stretches(ctx, goals_of(ctx, joint), excluded):
            moved = _leaves(ctx, joint, begin, end, goal)
            if moved is None:
                continue
            rad, at = moved
            when = "before the first command"
            if goal is not None:
                when = f"at its goal {goal:.2f} {ctx.unit}"
            text = f"at rest {when}, it moved by {rad:.3f} {ctx.unit} at {at:.2f} s"
            yield Figure(rad, at, None, joint, text)


def _stretches(
    ctx: Context, goals: Goals, excluded: list[tuple[float, float]]
) -> list[tuple[float, float, float | None]]:
    """Begin, end and goal of each stretch with one goal, outside of the excluded ones.

    The goal of the stretches before the first command, and after a restart of the service, is None.
    """
    found: list[tuple[float, float, float | None]] = []
    shutdowns = [ctx.span(p) for p in ctx.phases("shutdown")]
    restarts = [ctx.span(p) for p in ctx.phases("restarted")]
    for begin in (float(ctx.states.t[0]), *(begin for begin, _ in restarts)):
        later = ctx.commands.t[ctx.commands.t >= begin]
        found.append((begin, float(later[0]) if len(later) else ctx.recording.duration, None))
    ends = np.append(goals.t[1:], ctx.recording.duration)
    for begin, end, low, high in zip(goals.t, ends, goals.low, goals.high, strict=True):
        a, b = float(begin), float(end)
        if low != high or b - a < 2 * _AT_REST_S:
            continue
        # the new service knows nothing of the goal, and need not be where the old one was
        for x, y in sorted([*excluded, *shutdowns, *restarts]):
            if x <= a < y:
                a = y
            elif a < x < b:
                found.append((a, x, float(low)))
                a = y
        if b > a:
            found.append((a, b, float(low)))
    return found


def _leaves(
    ctx: Context, joint: int, begin: float, end: float, goal: float | None
) -> tuple[float, float] | None:
    """Motion of a joint away from its rest position, rad, and the time.

    Motion from there towards the goal does not count: a slow joint may still arrive. None if it
    does not come
    to rest in [begin, end].
    """
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows, joint]
    good = np.isfinite(q)
    t, q = t[good], q[good]
    rest = _UNDRIVEN_S if goal is None else _AT_REST_S
    count = int(np.searchsorted(t, t[0] + rest)) if len(t) else 0
    if count < 5 or len(t) < 2 * count:
        return None
    windows = sliding_window_view(q, count)
    calm = np.ptp(windows, axis=1) <= _AT_REST_PART * ctx.joints[joint].stroke
    if not calm.any():
        return None
    first = int(np.argmax(calm))
    here = float(np.median(windows[first]))
    low, high = (here, here) if goal is None else (min(here, goal), max(here, goal))
    away = np.maximum(low - q[first:], q[first:] - high)
    i = int(np.argmax(away))
    return max(0.0, float(away[i])), float(t[first + i])


_CONTACT_S = 0.7  # s after which the joints stand at the object


_STANDS_S = 0.4  # s within which a joint that stands has come to its goal


_FASTEST_HZ = 60.0  # frequency up to which a vibration is looked for


_PERIODS = 1.5  # fewest periods that tell a vibration from a motion


_BELOW_NYQUIST = 0.4  # part of the rate of states; a wave of half of it is not told from noise


_CHANCE = 1e-7  # probability with which white noise is taken for one, in each stretch


@check("BRAINCO-STILL-02")
@worst("turns_hz", "max_turns_hz", nothing="no joint stood for long enough")
def vibrates(ctx: Context) -> Figures:
    """The most reversals of q per second of a joint with a constant goal.

    Those of small size count where one frequency explains q, and noise of the measurement does not.
    """
    limit = ctx.tolerance("max_turns_hz")
    for begin, end in _rests(ctx):
        rows = ctx.states.between(begin, end)
        if len(ctx.states.t[rows]) < 10:
            continue
        for joint in range(len(ctx.joints)):
            t, q = ctx.states.t[rows], ctx.states.q[rows, joint]
            t, q = t[np.isfinite(q)], q[np.isfinite(q)]
            rate = _turn_rate(ctx, t, q, "min_turn_stroke", joint)
            if rate > limit and not _repeats(t, q, 0.5 * limit):
                rate = _turn_rate(ctx, t, q, "max_noise_stroke", joint)
            size = float(np.ptp(q)) if len(q) else 0.0
            text = f"turns {rate:.1f} times a second at rest, over {size:.3f} {ctx.unit}"
            yield Figure(rate, begin, end, joint, text, shown=f"{rate:.1f} /s")


def _turn_rate(ctx: Context, t: Floats, q: Floats, least: str, joint: int) -> float:
    """Reversals of q a second of at least this tolerance; 0 where they are few."""
    turns = _turns(q, ctx.tolerance(least, joint))
    return turns / float(t[-1] - t[0]) if turns >= ctx.tolerance("min_turns") else 0.0


def _repeats(t: Floats, q: Floats, lowest: float) -> bool:
    """Whether one frequency explains more of q than it ever does of noise without a frequency.

    :param lowest: frequency, Hz.
    """
    seconds = float(t[-1] - t[0])
    if not seconds:
        return False
    off = q - np.polyval(np.polyfit(t - t[0], q, 1), t - t[0])  # it may still come to rest
    power = float(off @ off)
    highest = min(_BELOW_NYQUIST * (len(t) - 1) / seconds, _FASTEST_HZ)
    tried = np.arange(max(lowest, _PERIODS / seconds), highest, 0.5 / seconds)
    if not power or not len(tried):
        return False
    waves = np.exp(-2j * np.pi * np.outer(tried, t - t[0]))
    explained = float((np.abs(waves @ off) ** 2).max()) * 2.0 / (len(q) * power)
    # of white noise each frequency explains x or more with a probability of (1 - x) ** half
    half = 0.5 * (len(q) - 3)
    return bool(explained > 1.0 - (_CHANCE / len(tried)) ** (1.0 / half))


def _rests(ctx: Context) -> list[tuple[float, float]]:
    """Stretches with constant goals that are reached or blocked."""
    found = [ctx.span(p) for p in ctx.phases("listen")]
    # one side grips while the other holds its pose
    found += [
        (begin + _CONTACT_S, end) for begin, end in map(ctx.span, ctx.recording.phases("squeeze"))
    ]
    window = ctx.tolerance("window_s")
    for begin, end in map(ctx.span, ctx.phases()):
        if end - window >= begin + _STANDS_S:
            found.append((end - window, end))
    return found


def _turns(q: Floats, least: float) -> int:
    """Number of reversals of q of at least this size."""
    turns, way, extreme = 0, 0, float(q[0]) if len(q) else 0.0
    for value in q.tolist():
        if way >= 0 and value < extreme - least:
            turns, way, extreme = turns + (way > 0), -1, value
        elif way <= 0 and value > extreme + least:
            turns, way, extreme = turns + (way < 0), 1, value
        elif (value - extreme) * (way or 1) > 0:
            extreme = value
    return turns
