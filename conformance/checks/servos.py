"""Check hands of position servos by their positions alone: speed, grip, rest and silence.

Such a hand has no gains, and the force of its currents is not documented. So a grip is recognised
by position: the joints stand at the object while their goals lie beyond it.
"""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import STROKE_S, Context, Outcome, check
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
def slow_command(ctx: Context) -> Outcome:
    """The top speed of a joint that is commanded to move slowly."""
    worst: tuple[float, int, tuple[float, float]] | None = None
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin + _TURNS_S, end)
        t, q = ctx.states.t[rows], ctx.states.q[rows]
        if len(t) < 5:
            continue
        for joint in phase.targets.get(ctx.side, {}):
            part = float(np.ptp(q[:, joint])) / float(t[-1] - t[0]) / ctx.joints[joint].dq_max
            if worst is None or part > worst[0]:
                worst = part, joint, (begin, end)
    if worst is None:
        return ctx.skipped("no joint was commanded to move slowly")
    part, joint, span = worst
    text = ctx.named(f"moved with {part:.0%} of its full speed", joint)
    if part <= ctx.tolerance("max_part"):
        return ctx.passed(f"{part:.0%}", text, part=part)
    return ctx.failed(f"{part:.0%}", text, ctx.at(ctx.states.topic, *span), part=part).about(joint)


def _commanded_speeds(ctx: Context) -> list[tuple[Step, float]]:
    """The motions of a phase in which every joint has a speed of its own, and that speed."""
    found = []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        given = ctx.commands.dq[(ctx.commands.t >= begin) & (ctx.commands.t <= end)]
        given = given[np.isfinite(given).all(axis=1)]
        if len(given):
            found += [(s, float(np.median(given[:, s.joint]))) for s in steps_of(ctx, phase)]
    return found


@check("BRAINCO-SPEED-02")
def no_speed(ctx: Context) -> Outcome:
    """Motion of a joint that is commanded to another position with a speed of 0 or less."""
    moved = [
        (float(np.abs(step.q - step.start).max()) / step.stroke, step)
        for step, asked in _commanded_speeds(ctx)
        if asked <= 0.0
    ]
    if not moved:
        return ctx.skipped("no joint was commanded with a speed of 0 or less")
    part, step = max(moved, key=lambda m: m[0])
    way, limit = part * step.stroke, ctx.tolerance("max_motion_stroke", step.joint)
    text = f"{step.name}moved by {way:.3f} {ctx.unit} with a speed of 0 or less"
    figure = f"{way:.3f} {ctx.unit}"
    if way <= limit:
        return ctx.passed(figure, text, motion_rad=way).placed(way, limit)
    place = ctx.at(ctx.states.topic, step.begin, step.end)
    outcome = ctx.failed(figure, text, place, motion_rad=way)
    return outcome.about(step.joint).placed(way, limit).if_late(STROKE_S * part)


@check("BRAINCO-SPEED-03")
def own_speeds(ctx: Context) -> Outcome:
    """Speed of each joint relative to the one that it is commanded to move with."""
    worst: tuple[float, Step, float, float] | None = None
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
        if worst is None or excess > worst[0]:
            worst = excess, step, asked, part
    if worst is None:
        return ctx.skipped("no joint was commanded with a speed of its own")
    excess, step, asked, part = worst
    text = f"{step.name}moved with {part:.0%} of its full speed, commanded with {asked:.0%}"
    if excess <= 1.0:
        return ctx.passed(f"{part:.0%} of {asked:.0%}", text, part=part)
    place = ctx.at(ctx.states.topic, step.begin, step.end)
    return ctx.failed(f"{part:.0%} of {asked:.0%}", text, place, part=part).about(step.joint)


@check("BRAINCO-GRIP-01")
def keeps_grip(ctx: Context) -> Outcome:
    """Opening of a joint that presses on the object while it is commanded to close."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    worst: tuple[float, int, float] | None = None
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        for joint, opened, at in _gives_way(ctx, phase, begin + _CONTACT_S, end):
            if worst is None or opened > worst[0]:
                worst = opened, joint, at
        gap = longest_gap(ctx, ctx.tolerance("max_gap_s"), begin, end)
        if gap.value > gap.limit:
            text = f"no state for {gap.value:.2f} s while it grips"
            outcome = ctx.failed(f"{gap.value:.2f} s", text, ctx.at(ctx.states.topic, begin, end))
            return outcome.resting_on(gap).if_late(gap.value - gap.limit)
    if worst is None:
        return ctx.skipped("no joint was held back by the object")
    opened, joint, at = worst
    limit = ctx.tolerance("max_back_stroke", joint)
    text = ctx.named(f"opened by {opened:.3f} {ctx.unit} while it was commanded to grip", joint)
    if opened <= limit:
        return ctx.passed(f"{opened:.3f} {ctx.unit}", text, motion_rad=opened).placed(opened, limit)
    place = ctx.at(ctx.states.topic, at)
    outcome = ctx.failed(f"{opened:.2f} {ctx.unit}", text, place, motion_rad=opened).tolerated()
    return outcome.about(joint).placed(opened, limit).if_late(STROKE_S * opened)


def _gives_way(
    ctx: Context, phase: Phase, begin: float, end: float
) -> list[tuple[int, float, float]]:
    """Joint, how far it opens, and when, of each joint that the object holds back."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows]
    if len(t) < 5:
        return []
    found = []
    for joint, target in phase.targets.get(ctx.side, {}).items():
        spec = ctx.joints[joint]
        closed = q[:, joint] * spec.closing
        if target * spec.closing - float(closed[0]) < ctx.tolerance("min_held_stroke", joint):
            continue  # it arrived, or nearly
        opened = np.maximum.accumulate(closed) - closed
        i = int(np.argmax(opened))
        found.append((joint, float(opened[i]), float(t[i])))
    return found


@check("BRAINCO-STILL-02")
def vibrates(ctx: Context) -> Outcome:
    """The most reversals of q per second of a joint with a constant goal.

    Those of small size count where one frequency explains q, and noise of the measurement does not.
    """
    worst: tuple[float, int, tuple[float, float], float] | None = None
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
            if worst is None or rate > worst[0]:
                worst = rate, joint, (begin, end), float(np.ptp(q)) if len(q) else 0.0
    if worst is None:
        return ctx.skipped("no joint stood for long enough")
    rate, joint, span, size = worst
    text = ctx.named(f"turns {rate:.1f} times a second at rest, over {size:.3f} {ctx.unit}", joint)
    if rate <= limit:
        return ctx.passed(f"{rate:.1f} /s", text, turns_hz=rate)
    place = ctx.at(ctx.states.topic, *span)
    return ctx.failed(f"{rate:.0f} /s", text, place, turns_hz=rate).about(joint)


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
def takes_no_detour(ctx: Context) -> Outcome:
    """Deviation of a joint from the way to its last goal while there are no commands."""
    worst: tuple[float, int, float] | None = None
    for begin, end, goal in _silences(ctx):
        rows = ctx.states.between(begin, end)
        t, q = ctx.states.t[rows], ctx.states.q[rows]
        if len(t) < 5:
            continue
        here = q[0]
        low, high = np.minimum(here, goal), np.maximum(here, goal)
        beyond = np.maximum(low - q, q - high)
        for joint, spec in enumerate(ctx.joints):
            i = int(np.nanargmax(beyond[:, joint]))
            part = float(beyond[i, joint]) / spec.stroke
            if worst is None or part > worst[0]:
                worst = part, joint, float(t[i])
    if worst is None:
        return ctx.skipped("no pause of commands with states")
    part, joint, at = worst
    beyond_rad = max(part, 0.0) * ctx.joints[joint].stroke
    limit = ctx.tolerance("max_motion_stroke", joint)
    text = ctx.named(
        f"left the way to its last goal by {beyond_rad:.3f} {ctx.unit} without a command", joint
    )
    if beyond_rad <= limit:
        met = ctx.passed(f"{beyond_rad:.3f} {ctx.unit}", text, motion_rad=beyond_rad)
        return met.placed(beyond_rad, limit)
    place = ctx.at(ctx.states.topic, at)
    outcome = ctx.failed(f"{beyond_rad:.2f} {ctx.unit}", text, place, motion_rad=beyond_rad)
    return outcome.about(joint).placed(beyond_rad, limit).if_late(STROKE_S * part)


@check("BRAINCO-WDOG-04")
def stops_in_silence(ctx: Context) -> Outcome:
    """Whether a moving joint stands still after the time-out."""
    least = ctx.requirement.tolerance("min_left_stroke")
    seen = False
    for begin, end, goal in _silences(ctx):
        late = begin + ctx.tolerance("timeout_s") + ctx.tolerance("grace_s")
        q = ctx.states.q[ctx.states.between(late, end)]
        if len(q) < 5:
            continue
        for joint, spec in enumerate(ctx.joints):
            if abs(goal[joint] - q[0, joint]) < least * spec.stroke:
                continue
            moved = float(np.ptp(q[:, joint]))
            if moved > ctx.tolerance("max_motion_stroke", joint):
                return ctx.failed(
                    "goes on",
                    ctx.named(
                        f"moved by {moved:.2f} {ctx.unit} more than "
                        f"{ctx.tolerance('timeout_s'):g} s after the last command",
                        joint,
                    ),
                    ctx.at(ctx.states.topic, late, end),
                    motion_rad=moved,
                ).about(joint)
            seen = True
    if not seen:
        return ctx.skipped("no joint was on its way at the time-out")
    return ctx.passed("stops", "what was on its way stands still after the time-out")


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
