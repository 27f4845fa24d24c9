"""What a client must send.

Intervals are measured by the client's source timestamps, where the recording has them. Only
commands that drive a joint are compared with its range, because zero gains stop a hand whatever q
is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.robot import RobotContext
from dexkit.conformance.kit.provenance import MESSAGES, STATES, TIMES
from dexkit.conformance.kit.results import Evidence
from dexkit.conformance.kit.sums import total
from dexkit.hand import Floats, JointMode
from dexkit.models import ModeByte, model
from dexkit.other_interfaces import TWO_FINGERS, is_two_fingers

_MOST_PLACES = 5


_FEWEST = 20
"""Fewest commands of a session."""


_SAME = 1e-6
"""Relative difference of two times that counts as rounding."""


_MOVES = 0.02
"""Smallest change of a moving target, as a part of the joint's range."""


_COMES_BACK = 4
"""Number of commands within which q returns, if two clients alternate."""


_NEAR = 0.25
"""Distance from the old q, as a part of the jump, that counts as returned."""


Mask = NDArray[np.bool_]


def sessions(ctx: Context) -> list[slice]:
    """The commands by session: a pause longer than the hand's time-out separates two.

    A run of fewer than :data:`_FEWEST` commands does not count as a session. Otherwise a client
    slower than one command in that time would have no session.
    """
    times = _clock(ctx)
    pause = model(ctx.recording.dialect.model).command_timeout
    edges = [0, *(int(i) + 1 for i in np.flatnonzero(np.diff(times) > pause)), len(times)]
    lengths = np.diff(edges)
    ends = [
        edge
        for edge, before, after in zip(edges[1:-1], lengths[:-1], lengths[1:], strict=True)
        if min(before, after) >= _FEWEST
    ]
    return [slice(a, b) for a, b in zip([0, *ends], [*ends, len(times)], strict=True)]


def _clock(ctx: Context) -> Floats:
    return np.sort(ctx.commands.clock)


def _places(ctx: Context, rows: NDArray[np.intp]) -> list[Evidence]:
    """Places of single commands."""
    return [ctx.at(ctx.commands.topic, float(ctx.commands.t[i])) for i in rows[:_MOST_PLACES]]


def _driven(ctx: Context) -> Mask:
    """Whether each command drives each joint, shape (n, n_joints)."""
    commands = ctx.commands
    if not ctx.recording.dialect.gains_are_used:
        return np.isfinite(commands.q)
    return np.asarray((commands.kp != 0) | (commands.kd != 0) | (commands.tau != 0))


def _between_stops(ctx: Context, driven: Mask) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Each joint's commands from the first to the last that drives it, by session.

    A joint that is never driven although its q moves is included with all of its commands.
    """
    q = ctx.commands.q
    for part in sessions(ctx):
        for joint, spec in enumerate(ctx.joints):
            rows = np.flatnonzero(driven[part, joint]) + part.start
            if len(rows):
                yield joint, np.arange(rows[0], rows[-1] + 1)
                continue
            target = q[part, joint][np.isfinite(q[part, joint])]
            if len(target) and float(np.ptp(target)) > _MOVES * spec.stroke:
                yield joint, np.arange(part.start, part.stop)


@check("DEX1-CLIENT-01", rests_on=(MESSAGES,))
def length(ctx: Context) -> Outcome:
    """Motors in the sequence of each command."""
    found, due = ctx.commands.length, ctx.recording.dialect.length
    wrong = np.flatnonzero(found != due)
    if not len(wrong):
        return ctx.passed(str(due), f"{len(found)} commands")
    other = [int(n) for n in np.unique(found[wrong])]
    names = " or ".join("no readable sequence" if n < 0 else f"{n} motors" for n in other)
    return ctx.failed(
        "/".join("?" if n < 0 else str(n) for n in other),
        f"{len(wrong)} of {len(found)} commands hold {names} instead of {due}",
        *_places(ctx, wrong),
    )


@check("DEX1-CLIENT-02", rests_on=(MESSAGES,))
def finite(ctx: Context) -> Outcome:
    """NaN and infinite values in commands that contain all joints."""
    commands = ctx.commands
    whole = commands.length >= ctx.recording.dialect.length
    wrong = np.zeros(len(commands), dtype=np.bool_)
    named, joints = [], np.zeros(len(ctx.joints), dtype=np.bool_)
    for name in ("q", "dq", "tau", "kp", "kd"):
        bad = ~np.isfinite(getattr(commands, name)) & whole[:, None]
        if bad.any():
            named.append(name)
            wrong |= bad.any(axis=1)
            joints |= bad.any(axis=0)
    if not named:
        return ctx.passed("finite", f"{len(commands)} commands")
    rows = np.flatnonzero(wrong)
    return ctx.failed(
        f"{len(rows)} not finite",
        f"{' and '.join(named)} is not a finite number in {len(rows)} of {len(commands)} commands",
        *_places(ctx, rows),
    ).about(*np.flatnonzero(joints))


@check("DEX1-CLIENT-03", explained_by=("kp",))
def in_range(ctx: Context) -> Outcome:
    """Commanded positions outside the joint's range."""
    q, driven = ctx.commands.q, _driven(ctx)
    margin = ctx.tolerance("margin_rad")
    low = np.array([j.q_min - margin for j in ctx.joints])
    high = np.array([j.q_max + margin for j in ctx.joints])
    finite_q = np.where(np.isfinite(q) & driven, q, np.clip(0.0, low, high))
    beyond = np.maximum(finite_q - high, low - finite_q)
    rows = np.flatnonzero((beyond > 0).any(axis=1))
    if not len(rows):
        return ctx.passed("within", f"{len(q)} commands within the range of every joint")
    row, joint = (int(i) for i in np.unravel_index(int(np.argmax(beyond)), beyond.shape))
    far, spec = float(finite_q[row, joint]), ctx.joints[joint]
    text = ctx.named(
        f"q of {len(rows)} of {len(q)} commands is out of range, up to {far:.4g}; the range is "
        f"{spec.q_min:.2f} to {spec.q_max:.2f} {ctx.unit}",
        joint,
    )
    outcome = ctx.failed(f"{far:.4g}", text, *_places(ctx, rows)).about(joint)
    unit = _unit(far, spec.q_max - spec.q_min)
    return outcome.because(f"q is in {unit}, not in radians.") if unit else outcome


def _unit(far: float, stroke: float) -> str:
    """Guess the unit of a value that is not in radians; empty if none fits."""
    degrees = 1.1 * math.degrees(stroke)
    if abs(far) <= 2 * stroke:
        return ""
    if abs(far) <= 100.0:
        return "percent or degrees" if abs(far) <= degrees else "percent"
    return "degrees" if abs(far) <= degrees else ""


@check("DEX1-CLIENT-04", explained_by=("kp",))
def not_normalised(ctx: Context) -> Outcome:
    """Whether q runs from 0 to exactly 1 and rests there, like a normalised value.

    At first it may be larger: the hand's position, which the client takes for a normalised value.
    """
    q = ctx.commands.q[:, 0]
    q = q[np.isfinite(q) & _driven(ctx)[:, 0]]
    if not len(q):
        return ctx.skipped("no command drives the hand")
    low, top, near = float(q.min()), float(q.max()), ctx.tolerance("near_rad")
    rests, above = float((np.abs(q - 1.0) <= near).mean()), float((q > 1.0 + near).mean())
    text = (
        f"q is {low:.2f} to {top:.2f} {ctx.unit}; {rests:.0%} of commands at 1, "
        f"{above:.0%} above it"
    )
    usual = (
        low > near
        or rests < ctx.tolerance("min_rest_part")
        or above > ctx.tolerance("max_above_part")
    )
    if usual:
        return ctx.passed(f"to {top:.2f} {ctx.unit}", text)
    return ctx.failed("0 to 1", text, ctx.at(ctx.commands.topic, float(ctx.commands.t[0])))


@check("DEX1-CLIENT-09", rests_on=("kp",))
def gains(ctx: Context) -> Outcome:
    """Kp and kd, compared with those that Unitree's client sends."""
    commands, most = ctx.commands, ctx.tolerance("max_factor")
    usual = model(ctx.recording.dialect.model).gains
    checked = 0
    worst, found, place = most, "", (0, 0)
    for joint, rows in _between_stops(ctx, (commands.kp != 0) | (commands.kd != 0)):
        for name, values, due in (
            ("kp", commands.kp[rows, joint], usual[joint][0]),
            ("kd", commands.kd[rows, joint], usual[joint][1]),
        ):
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.where(values > 0, values / due, 0.0)
                factor = np.where(np.isfinite(values), np.maximum(ratio, 1.0 / ratio), 1.0)
            at = int(np.argmax(factor))
            checked += len(rows)
            if factor[at] > worst * (1.0 + _SAME):
                worst, place = float(factor[at]), (int(rows[at]), joint)
                found = ctx.named(
                    f"{name} is {values[at]:.4g}, Unitree's client sends {due:g}", joint
                )
    if not checked:
        return ctx.skipped("no command drives the hand")
    if not found:
        return ctx.passed("usual", f"kp and kd within a factor of {most:g} of Unitree's client's")
    row, joint = place
    figure = found.partition(",")[0].rpartition(": ")[2].replace(" is ", " ")
    return ctx.failed(figure, found, *_places(ctx, np.array([row]))).about(joint)


@check("DEX1-CLIENT-14", rests_on=("kp",))
def no_gains(ctx: Context) -> Outcome:
    """Gains where they have no effect."""
    commands = ctx.commands
    rows = np.flatnonzero(((commands.kp != 0) | (commands.kd != 0)).any(axis=1))
    if not len(rows):
        return ctx.passed("0", f"kp = kd = 0 in {len(commands)} commands")
    text = f"kp or kd is not 0 in {len(rows)} of {len(commands)} commands"
    return ctx.failed("not 0", text, *_places(ctx, rows))


@check("DEX1-CLIENT-10", rests_on=("mode",))
def mode(ctx: Context) -> Outcome:
    """The mode byte of each motor's command."""
    kind, modes = ctx.recording.dialect.mode_byte, ctx.commands.mode
    if len(ctx.commands) and is_two_fingers(ctx.commands.q[0], ctx.commands.kp[0]):
        return ctx.skipped(f"the commands are for {TWO_FINGERS}")
    whole = np.isfinite(modes)
    value = np.where(whole, modes, 0).astype(np.intp)
    index = np.arange(modes.shape[1])
    status = value >> 4 & 7 if kind is ModeByte.RIS else value
    wrong = whole & (status != JointMode.FOC) & (status != JointMode.BRAKE)
    if kind is ModeByte.RIS:
        wrong |= whole & ((value & 15) != index)
    if kind is not ModeByte.UNUSED:  # a moving motor is driven
        for joint, rows in _between_stops(ctx, whole & (status == JointMode.FOC)):
            wrong[rows, joint] |= whole[rows, joint] & (status[rows, joint] != JointMode.FOC)
    if not wrong.any():
        return ctx.passed("right", f"{len(modes)} commands")
    rows = np.flatnonzero(wrong.any(axis=1))
    joint = int(np.argmax(wrong[rows[0]]))
    due = {
        ModeByte.UNUSED: "0 or 1",
        ModeByte.STATUS: "1 while the joint is driven, and 0 to stop it",
        ModeByte.RIS: f"0x{JointMode.FOC << 4 | joint:02x} while the motor is driven",
    }[kind]
    text = f"mode is 0x{int(value[rows[0], joint]):02x}, not {due}"
    text = f"{ctx.named(text, joint)}; {len(rows)} of {len(modes)} commands are wrong"
    follows = _follows(ctx, wrong)
    if follows:
        text += "; the hand follows them all the same"
    outcome = ctx.failed(f"0x{int(value[rows[0], joint]):02x}", text, *_places(ctx, rows))
    outcome = outcome.about(*np.flatnonzero(wrong.any(axis=0)))
    if not follows:
        return outcome
    return outcome.tolerated().because(
        "The firmware of this hand does not need the documented mode byte; another one locks its "
        "motors."
    )


_LAGS = np.arange(0.0, 0.5, 0.02)
"""Seconds by which a hand may be behind its commands."""


_GOES = 0.1
"""Part of the stroke that a goal must move to show whether a joint follows."""


_EXPLAINED = 0.5
"""Largest distance of a joint that follows from its goal, as a part of the goal's own motion, both
as standard deviations."""


def _follows(ctx: Context, wrong: Mask) -> bool:
    """Whether most joints with moving goals follow those commands that are ``wrong``."""
    commands, states = ctx.commands, ctx.states
    moving = following = 0
    for joint, spec in enumerate(ctx.joints):
        rows = wrong[:, joint] & _driven(ctx)[:, joint] & np.isfinite(commands.q[:, joint])
        t, goal = commands.t[rows], commands.q[rows, joint]
        good = np.isfinite(states.q[:, joint])
        if not len(goal) or float(np.ptp(goal)) < _GOES * spec.stroke or good.sum() < _FEWEST:
            continue
        moving += 1
        spread = float(np.std(goal))
        least = min(
            float(np.std(np.interp(t + lag, states.t[good], states.q[good, joint]) - goal))
            for lag in _LAGS
        )
        following += least < _EXPLAINED * spread
    return following > moving / 2


def slow_stretches(
    t: Floats, rate: float, window: float
) -> tuple[float, list[tuple[float, float]]]:
    """The lowest rate in sliding windows of the commands, Hz, and where it is below ``rate``.

    It is below where as many intervals as fit into ``window`` seconds at ``rate`` take longer: a
    steady client of exactly ``rate`` passes.

    :param t: seconds, rising.
    :returns: the rate is infinite for commands of less than ``window`` seconds in all.
    """
    if len(t) < 2 or t[-1] - t[0] < window:
        return math.inf, []
    count = min(max(1, round(rate * window)), len(t) - 1)
    spans = t[count:] - t[:-count]
    slow = np.flatnonzero(spans * rate > count * (1.0 + _SAME))
    stretches: list[tuple[float, float]] = []
    for i in slow:
        begin, end = float(t[i]), float(t[i + count])
        if stretches and begin <= stretches[-1][1]:
            stretches[-1] = (stretches[-1][0], end)
        else:
            stretches.append((begin, end))
    if stretches:
        return count / float(spans.max()), stretches
    inside = np.searchsorted(t, t + window, "right") - 1
    first = np.flatnonzero(t + window <= t[-1])
    last = inside[first]
    return float(((last - first) / (t[last] - t[first])).min(initial=math.inf)), []


@check("DEX1-CLIENT-05", rests_on=(TIMES,))
def rate(ctx: Context) -> Outcome:
    """The least rate of commands; where it is enough, whether it is that of Unitree's client, and
    the longest interval.
    """
    enough = _rate(ctx, ctx.tolerance("min_rate_hz"), ctx.tolerance("window_s"))
    if enough.met is False:
        return enough
    usual = _rate(ctx, ctx.tolerance("usual_rate_hz"), ctx.tolerance("usual_window_s"))
    return all_of(enough, warning(usual), warning(_gap(ctx)))


def _rate(ctx: Context, limit: float, window: float) -> Outcome:
    """The least rate of commands in a sliding window, Hz."""
    t = _clock(ctx)
    least, found = math.inf, []
    for part in sessions(ctx):
        lowest, stretches = slow_stretches(t[part], limit, window)
        least = min(least, lowest)
        found += stretches
    if math.isinf(least):
        return ctx.skipped(f"commands are sent for less than {window:g} s")
    if not found:
        return ctx.passed(
            f"{least:.0f} Hz", f"at least {least:.0f} Hz in any {window:g} s", min_rate_hz=least
        )
    seconds = sum(end - begin for begin, end in found)
    places = [ctx.at(ctx.commands.topic, *stretch) for stretch in found[:_MOST_PLACES]]
    return ctx.failed(
        f"{least:.3g} Hz",
        f"the client sends {least:.3g} Hz from {found[0][0]:.2f} s on; less than {limit:g} Hz for "
        f"{seconds:.1f} s in all",
        *places,
        min_rate_hz=least,
    )


def _gap(ctx: Context) -> Outcome:
    """The longest interval between two commands of a session."""
    t, limit = _clock(ctx), ctx.tolerance("max_gap_s")
    longest, found = 0.0, []
    for part in sessions(ctx):
        steps = np.diff(t[part])
        longest = max(longest, float(steps.max(initial=0.0)))
        found += [
            (float(t[part][i]), float(t[part][i + 1]))
            for i in np.flatnonzero(steps > limit * (1.0 + _SAME))
        ]
    if not found:
        return ctx.passed(f"{longest * 1e3:.0f} ms", f"the longest is {longest * 1e3:.1f} ms")
    places = [ctx.at(ctx.commands.topic, *stretch) for stretch in found[:_MOST_PLACES]]
    return ctx.failed(
        f"{longest:.3g} s",
        f"{len(found)} intervals above {limit:g} s, the longest {longest:.3g} s",
        *places,
        max_gap_s=longest,
    )


def distance_from_states(ctx: Context, joint: int, memory: float) -> Floats:
    """Distance of each commanded q from the states available to the client, rad.

    These are the states of the last ``memory`` seconds and the one before, because a client reads a
    state later than the recorder and smooths several. NaN without states.
    """
    states, commands = ctx.states, ctx.commands
    distance = np.full(len(commands), np.nan)
    last = np.searchsorted(states.t, commands.t, "right")
    first = np.maximum(np.searchsorted(states.t, commands.t - memory) - 1, 0)
    rows = np.flatnonzero(last > first)
    if not len(rows):
        return distance
    q = np.append(states.q[:, joint], np.nan)  # a place for the end of the last window
    bounds = np.column_stack([first[rows], last[rows]]).ravel()
    lowest = np.fmin.reduceat(q, bounds)[::2]
    highest = np.fmax.reduceat(q, bounds)[::2]
    goal = commands.q[rows, joint]
    distance[rows] = np.maximum(np.maximum(goal - highest, lowest - goal), 0.0)
    return distance


@check("DEX1-CLIENT-08", rests_on=(TIMES,))
def lead(ctx: Context) -> Outcome:
    """Lead of a command over the last states."""
    limit, driven = ctx.requirement.tolerance("max_lead_stroke"), _driven(ctx)
    if not np.ptp(ctx.states.q, axis=0).any():
        return ctx.skipped("q of the hand never changes: that is no fault of the client")
    far: Floats = np.empty(0)
    worst, which = -1.0, 0
    for joint, spec in enumerate(ctx.joints):
        distance = np.where(driven[:, joint], distance_from_states(ctx, joint, 0.05), np.nan)
        known = distance[np.isfinite(distance)] / spec.stroke
        if len(known) and float(known.max()) > worst:
            worst, far, which = float(known.max()), distance, joint
    if worst < 0:
        return ctx.skipped("no state before a command that drives the hand")
    stroke = ctx.joints[which].stroke
    text = ctx.named(f"at most {worst * stroke:.2f} {ctx.unit} from the last states", which)
    if worst <= limit:
        return ctx.passed(f"{worst * stroke:.2f} {ctx.unit}", text, lead_rad=worst * stroke)
    rows = np.flatnonzero(np.nan_to_num(far) > limit * stroke)
    text = ctx.named(
        f"{len(rows)} of {len(far)} commands are further than {limit * stroke:.2f} {ctx.unit} "
        "from the "
        f"last states, up to {worst * stroke:.2f} {ctx.unit}",
        which,
    )
    outcome = ctx.failed(
        f"{worst * stroke:.2f} {ctx.unit}", text, *_places(ctx, rows), lead_rad=worst * stroke
    )
    return outcome.about(which)


def returns(q: Floats, least: float) -> Mask:
    """Whether each command jumps by more than ``least``, and one of the next returns.

    :param q: of one joint, shape (n,).
    """
    jump = np.diff(q)
    found = np.zeros(len(q), dtype=np.bool_)
    for later in range(1, _COMES_BACK + 1):
        back = np.abs(q[1 + later :] - q[: -1 - later])
        away = np.abs(jump[: len(back)])
        found[1 : 1 + len(back)] |= (away > least) & (back < _NEAR * away)
    return found


@check("DEX1-CLIENT-11", rests_on=(TIMES,))
def one_writer(ctx: Context) -> Outcome:
    """Commands that alternate between two targets, as from two clients."""
    window, fewest = ctx.tolerance("window_s"), round(ctx.tolerance("min_returns"))
    t = ctx.commands.t
    most, place, which = 0, 0.0, 0
    for joint in range(len(ctx.joints)):
        at = t[returns(ctx.commands.q[:, joint], ctx.tolerance("min_jump_stroke", joint))]
        counts = np.searchsorted(at, at + window, "right") - np.arange(len(at))
        if len(at) and int(counts.max()) > most:
            most, which = int(counts.max()), joint
            place = float(at[np.argmax(counts >= fewest)])
    if most < fewest:
        return ctx.passed("one", f"q alternates at most {most} times in {window:g} s")
    text = ctx.named(
        f"q alternates between two targets, {most} times in {window:g} s, from {place:.2f} s on",
        which,
    )
    where = ctx.at(ctx.commands.topic, place, place + window)
    return ctx.failed("two", text, where, returns=most).about(which)


@check("DEX1-CLIENT-12", rests_on=(TIMES, STATES))
def waits(ctx: Context) -> Outcome:
    """Whether a state came before the first command."""
    first = float(ctx.commands.t[0])
    if first < ctx.tolerance("min_observed_s"):
        return ctx.skipped("the recording begins after the first commands")
    if not len(ctx.states) or first < float(ctx.states.t[0]):
        came = f"{ctx.states.t[0] - first:.2f} s later" if len(ctx.states) else "never"
        return ctx.failed(
            "blind",
            f"the first command is sent at {first:.2f} s; the first state comes {came}",
            ctx.at(ctx.commands.topic, first),
        )
    wait = first - float(ctx.states.t[0])
    return ctx.passed(f"after {wait:.2f} s", f"{wait:.2f} s after the first state", wait_s=wait)


@check(
    "DEX1-CLIENT-13",
    rests_on=(
        TIMES,
        "kp",
    ),
)
@worst("speed_part", "max_speed_stroke", nothing="the recording ends before the client does")
def ends_at_rest(ctx: Context) -> Figures:
    """The speed of hand and target when the commands end."""
    commands, states = ctx.commands, ctx.states
    limit, look = ctx.requirement.tolerance("max_speed_stroke"), ctx.tolerance("window_s")
    seen = float(states.t[-1]) if len(states) else 0.0
    ends = [part for part in sessions(ctx) if commands.t[part][-1] + 0.5 <= seen]
    for part in ends:
        end = float(commands.t[part][-1])
        for joint, spec in enumerate(ctx.joints):
            rows = slice(part.start + int(np.searchsorted(commands.t[part], end - look)), part.stop)
            before = states.between(end - look, end)
            # "in motion" includes a moving target while an object holds the hand, and a hand that
            # moves to a resting target
            fastest = max(
                _speed(commands.t[rows], commands.q[rows, joint]),
                _speed(states.t[before], states.q[before, joint]),
            )
            if _is_stop(ctx, part.stop - 1, joint):
                fastest = 0.0
            part_s = fastest / spec.stroke
            text = (
                f"the last command is sent at {end:.2f} s, while the hand or its target moves by "
                f"{part_s:.0%} of the stroke a second"
            )
            yield Figure(
                part_s,
                end,
                None,
                joint,
                text,
                limit=limit,
                shown=f"{part_s:.0%}/s",
                topic=commands.topic,
            )


def _is_stop(ctx: Context, row: int, joint: int) -> bool:
    """Whether a command stops a joint: zero gains, or a mode that does not drive."""
    kind, commands = ctx.recording.dialect.mode_byte, ctx.commands
    if kind is not ModeByte.UNUSED and np.isfinite(commands.mode[row, joint]):
        value = int(commands.mode[row, joint])
        if (value >> 4 & 7 if kind is ModeByte.RIS else value) == JointMode.BRAKE:
            return True
    return not _driven(ctx)[row, joint]


def _speed(t: Floats, q: Floats) -> float:
    """Mean speed over the samples, rad/s; 0 for fewer than two."""
    good = np.isfinite(q)
    if good.sum() < 2:
        return 0.0
    t, q = t[good], q[good]
    return abs(float(q[-1] - q[0])) / float(t[-1] - t[0]) if t[-1] > t[0] else 0.0


@check("H1-CLIENT-01")
def client_crc(ctx: RobotContext) -> Outcome:
    """The CRC of commands, except for those that the kit has damaged on purpose."""
    intact, t = ctx.recording.commands_intact, ctx.commands.t
    counts = np.ones(len(t), dtype=np.bool_)
    for phase in ctx.phases("wrong-crc"):
        begin, end = ctx.span(phase)
        counts &= (t < begin - 0.02) | (t > end + 0.02)
    wrong = np.flatnonzero(counts & ~intact)
    if not len(wrong):
        return ctx.passed("right", f"{int(counts.sum())} commands")
    return ctx.failed(
        f"{len(wrong)} wrong",
        f"{len(wrong)} of {int(counts.sum())} commands carry a wrong CRC",
        *(ctx.at(ctx.commands.topic, float(t[i])) for i in wrong[:5]),
    )


@check("H1-CLIENT-02")
def client_rate(ctx: RobotContext) -> Outcome:
    """The mean rate of commands."""
    steps = np.diff(ctx.commands.t)
    steady = steps[steps <= 0.1]
    if total(steady) < ctx.tolerance("min_observed_s"):
        return ctx.skipped("hardly any steady commands in the recording")
    rate = len(steady) / total(steady)
    text = f"{len(ctx.commands)} commands, {rate:.0f} Hz while they are sent"
    if rate >= ctx.tolerance("min_rate_hz"):
        return ctx.passed(f"{rate:.0f} Hz", text)
    return ctx.failed(f"{rate:.0f} Hz", text)
