"""Check hands of position servos by their positions alone: speed, grip, rest and silence.

Such a hand has no gains, and the force of its currents is not documented. So a grip is recognised
by position: the joints stand at the object while their goals lie beyond it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, with_object, worst
from dexkit.conformance.checks.motion import Step, steps_of
from dexkit.conformance.checks.timing import longest_gap
from dexkit.conformance.stimulus_record import Phase
from dexkit.hand import Floats

_CONTACT_S = 0.7  # s after which the joints stand at the object
_TURNS_S = 0.08  # s after which a joint has taken up a new speed
_MOST_OF_IT = 0.9  # part of a way after which a joint may slow down
_STANDS_S = 0.4  # s within which a joint that stands has come to its goal
_FASTEST_HZ = 60.0  # frequency up to which a vibration is looked for
_PERIODS = 1.5  # fewest periods that tell a vibration from a motion
_BELOW_NYQUIST = 0.4  # part of the rate of states; a wave of half of it is not told from noise
_CHANCE = 1e-7  # probability with which white noise is taken for one, in each stretch


@check("BRAINCO-SPEED-01")
@worst("part", "max_part", nothing="no joint was commanded to move slowly")
def slow_command(ctx: Context) -> Figures:
    """The top speed of a joint that is commanded to move slowly."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin + _TURNS_S, end)
        t, q = ctx.states.t[rows], ctx.states.q[rows]
        if len(t) < 5:
            continue
        for joint in phase.targets.get(ctx.side, {}):
            part = float(np.ptp(q[:, joint])) / float(t[-1] - t[0]) / ctx.joints[joint].dq_max
            yield Figure(part, begin, end, joint, f"moved with {part:.0%} of its full speed")


def _commanded_speeds(ctx: Context) -> list[tuple[Step, float]]:
    """The motions of a phase in which every joint has a speed of its own, and that speed."""
    found = []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        given = ctx.commands.dq[ctx.given(begin, end)]
        given = given[np.isfinite(given).all(axis=1)]
        if len(given):
            found += [(s, float(np.median(given[:, s.joint]))) for s in steps_of(ctx, phase)]
    return found


@check("BRAINCO-SPEED-02")
@worst(
    "motion_rad",
    "max_motion_stroke",
    nothing="no joint was commanded with a speed of 0 or less",
)
def no_speed(ctx: Context) -> Figures:
    """Motion of a joint that is commanded to another position with a speed of 0 or less."""
    for step, asked in _commanded_speeds(ctx):
        if asked <= 0.0:
            way = float(np.abs(step.q - step.start).max())
            yield step.figure(way, f"moved by {way:.3f} {ctx.unit} with a speed of 0 or less")


@check("BRAINCO-SPEED-03")
@worst("excess", "max_ratio", nothing="no joint was commanded with a speed of its own")
def own_speeds(ctx: Context) -> Figures:
    """Speed of each joint relative to the one that it is commanded to move with."""
    slack = ctx.tolerance("slack")
    for step, asked in _commanded_speeds(ctx):
        way = (step.q - step.start) * np.sign(step.size)
        arrived = np.flatnonzero(way >= _MOST_OF_IT * abs(step.size))
        last = int(arrived[0]) if len(arrived) else len(way) - 1
        seconds = float(step.t[last]) - step.begin - ctx.tolerance("start_s")
        if asked <= 0.0 or seconds <= 0.0:
            continue
        part = float(way[last]) / seconds / ctx.joints[step.joint].dq_max
        excess = max(
            part / (ctx.tolerance("max_ratio") * asked + slack),
            (ctx.tolerance("min_ratio") * asked - slack) / max(part, 1e-6),
        )
        yield step.figure(
            excess,
            f"moved with {part:.0%} of its full speed, commanded with {asked:.0%}",
            shown=f"{part:.0%} of {asked:.0%}",
            limit=1.0,
            values={"part": part},
        )


@check("BRAINCO-GRIP-01")
@with_object
def keeps_grip(ctx: Context) -> Outcome:
    """Opening of a joint that presses on the object while it is commanded to close."""
    nothing = "no joint was held back by the object"
    outcome = judged(ctx, _openings(ctx), "motion_rad", "max_back_stroke", nothing=nothing)
    return outcome.tolerated() if outcome.met is False and outcome.joints else outcome


def _openings(ctx: Context) -> Figures:
    limit = ctx.tolerance("max_gap_s")
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        yield from _gives_way(ctx, phase, begin + _CONTACT_S, end)
        gap = longest_gap(ctx, limit, begin, end)
        if gap.value > limit:
            text = f"no state for {gap.value:.2f} s while it grips"
            outcome = ctx.failed(f"{gap.value:.2f} s", text, ctx.at(ctx.states.topic, begin, end))
            yield outcome.resting_on(gap).if_late(gap.value - limit)


def _gives_way(ctx: Context, phase: Phase, begin: float, end: float) -> Iterator[Figure]:
    """How far each joint that the object holds back opens."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows]
    if len(t) < 5:
        return
    for joint, target in phase.targets.get(ctx.side, {}).items():
        spec = ctx.joints[joint]
        closed = q[:, joint] * spec.closing
        if target * spec.closing - float(closed[0]) < ctx.tolerance("min_held_stroke", joint):
            continue  # it arrived, or nearly
        opened = np.maximum.accumulate(closed) - closed
        i = int(np.argmax(opened))
        text = f"opened by {opened[i]:.3f} {ctx.unit} while it was commanded to grip"
        yield Figure(float(opened[i]), float(t[i]), None, joint, text)


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


@check("BRAINCO-WDOG-01")
@worst("motion_rad", "max_motion_stroke", nothing="no pause of commands with states")
def takes_no_detour(ctx: Context) -> Figures:
    """Deviation of a joint from the way to its last goal while there are no commands."""
    for begin, end, goal in _silences(ctx):
        rows = ctx.states.between(begin, end)
        t, q = ctx.states.t[rows], ctx.states.q[rows]
        if len(t) < 5:
            continue
        low, high = np.minimum(q[0], goal), np.maximum(q[0], goal)
        beyond = np.maximum(low - q, q - high)
        for joint in range(len(ctx.joints)):
            i = int(np.nanargmax(beyond[:, joint]))
            rad = max(float(beyond[i, joint]), 0.0)
            text = f"left the way to its last goal by {rad:.3f} {ctx.unit} without a command"
            yield Figure(rad, float(t[i]), None, joint, text)


@check("BRAINCO-WDOG-04")
@worst("motion_rad", "max_motion_stroke", nothing="no joint was on its way at the time-out")
def stops_in_silence(ctx: Context) -> Figures:
    """Whether a moving joint stands still after the time-out."""
    for begin, end, goal in _silences(ctx):
        late = begin + ctx.tolerance("timeout_s") + ctx.tolerance("grace_s")
        q = ctx.q(late, end)
        if len(q) < 5:
            continue
        for joint in range(len(ctx.joints)):
            if abs(goal[joint] - q[0, joint]) >= ctx.tolerance("min_left_stroke", joint):
                moved = float(np.ptp(q[:, joint]))
                text = f"moved by {moved:.2f} {ctx.unit} more than {ctx.tolerance('timeout_s'):g} s"
                yield Figure(moved, late, end, joint, f"{text} after the last command")


def _silences(ctx: Context) -> list[tuple[float, float, Floats]]:
    """Last good command, end and its q, of each pause of commands."""
    commands = ctx.commands
    good = np.flatnonzero(np.isfinite(commands.q).all(axis=1))
    found = []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        sent = good[commands.t[good] <= min(begin + 0.05, end)]
        if len(sent):
            last = int(sent[-1])
            found.append((float(commands.t[last]), end, np.asarray(commands.q[last])))
    return found
