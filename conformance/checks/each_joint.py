"""Check each joint and finger separately: range, own mode byte, grip; and the low-rate copy of the
state.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, with_object, worst
from dexkit.conformance.checks.grip import torque_scales
from dexkit.conformance.checks.motion import Step, own_speed, steps
from dexkit.conformance.checks.safety import stays
from dexkit.conformance.checks.timing import gap_beside_states
from dexkit.conformance.measurement_error import Measure, Quantity
from dexkit.hand import Floats, JointMode
from dexkit.models import ModeByte

__all__: list[str] = []

_BEFORE_S = 0.1  # s before a phase or at its end in which a pose or a pressure is taken
_STATUS = 7  # mask of a mode byte's status, from bit 4 on


# --------------------------------------------------------------------------------------- range


@check("DEX3-MOVE-09")
def whole_range(ctx: Context) -> Outcome:
    """Distance of each joint from both ends of its range, unless the object holds it back."""
    found = steps(ctx)
    if not found:
        return ctx.failed("no state", f"no state of the {ctx.side} hand at its ends")
    figures = [s.error_figure(str(s)) for s in found if not _held(ctx, s)]
    nothing = "the object held every joint back"
    return judged(ctx, figures, "error_rad", "max_error_stroke", nothing=nothing)


def _held(ctx: Context, step: Step) -> bool:
    """Whether a joint presses on the hand's object with the commanded force."""
    spec = ctx.joints[step.joint]
    if ctx.object_at is None or (step.target - step.start) * spec.closing <= 0:
        return False
    tau = ctx.tau(step.end - _BEFORE_S, step.end)[:, step.joint]
    given = ctx.commands.kp[ctx.given(step.begin, step.end)]
    given = given[np.isfinite(given).all(axis=1)]
    if not len(tau) or not len(given):
        return False
    asked = min(float(np.median(given[:, step.joint])) * step.error, spec.tau_max)
    return abs(float(np.median(tau))) >= ctx.tolerance("min_part") * asked


# ---------------------------------------------------------------------------------- mode byte


def _mode_at(ctx: Context, begin: float, end: float) -> NDArray[np.intp] | None:
    """The mode bytes of the last command in [begin, end]."""
    mode = ctx.commands.mode[ctx.given(begin, end)]
    mode = mode[np.isfinite(mode).all(axis=1)]
    return mode[-1].astype(np.intp) if len(mode) else None


def _status(ctx: Context, mode: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The status in each joint's mode byte, and whether time-out protection is on."""
    if ctx.recording.dialect.mode_byte is ModeByte.RIS:
        return mode >> 4 & _STATUS, np.asarray(mode >> 7 & 1, dtype=np.bool_)
    return mode, np.zeros(len(mode), dtype=np.bool_)


_GOING = 0.9  # of a phase's time; a step may begin with it


@check("DEX3-MODE-05")
@worst("part", "min_progress", nothing="no state while some joints were driven and others were not")
def own_mode(ctx: Context) -> Figures:
    """Progress of driven joints while others are locked, have tripped or are protected.

    Protection that has not tripped changes nothing: in those steps all joints count.
    """
    for phase in (*ctx.phases(), *ctx.phases("guard-latch"), *ctx.phases("guarded-step")):
        begin, end = ctx.span(phase)
        mode = _mode_at(ctx, begin, end)
        if mode is None:
            continue
        status, tripped = _status(ctx, mode)
        if phase.name == "guarded-step":
            tripped = np.zeros_like(tripped)
        target = ctx.commands.q[ctx.given(begin, end)][-1]
        # a step may have begun before some of its joints were locked
        before, after = ctx.q(begin - 0.25, begin - 0.15), ctx.q(end - _BEFORE_S, end)
        if not len(before) or not len(after):
            continue
        start, final = np.median(before, axis=0), np.median(after, axis=0)
        for joint in np.flatnonzero((status == JointMode.FOC) & ~tripped).tolist():
            size = float(target[joint] - start[joint])
            least = ctx.tolerance("min_step_stroke", joint)
            if abs(size) < least:
                continue
            # a slow joint moves as far as its speed allows, less the time to start
            speed = own_speed(ctx, joint, ctx.requirement.tolerance("min_step_stroke"))
            if speed is not None:
                reach = _GOING * max(speed, ctx.tolerance("min_speed_rad_s")) * (end - begin)
                size = math.copysign(min(abs(size), max(reach, least)), size)
            part = float(final[joint] - start[joint]) / size
            text = (
                f"made {part:.0%} of a step of {size:.2f} {ctx.unit} while other joints were "
                "locked, had tripped or were protected"
            )
            yield Figure(part, begin, end, joint, text)


@check("DEX3-MODE-06")
@worst("motion_rad", "max_run_stroke", nothing="no state while joints were locked under way")
def lock_stops(ctx: Context) -> Figures:
    """Run-out of a joint that is locked while it moves, and whether it then stands still.

    It may take as long to obey the lock as it took to begin the step.
    """
    # of the first one: it begins at rest
    delay = max((_delay(ctx, *ctx.span(p)) for p in ctx.phases()[:1]), default=0.0)
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        mode = _mode_at(ctx, begin, end)
        rows = ctx.states.between(begin, end)
        t, q = ctx.states.t[rows], ctx.states.q[rows]
        if mode is None or len(t) < 5:
            continue
        late = q[t >= begin + ctx.tolerance("settle_s") + delay]
        for joint in np.flatnonzero(mode >> 4 & _STATUS == JointMode.BRAKE).tolist():
            speed = _top_speed(t, q[:, joint])
            runs = float(np.abs(q[:, joint] - q[0, joint]).max()) - speed * delay
            still = float(np.ptp(late[:, joint])) if len(late) else 0.0
            for far, name, what in (
                (max(runs, 0.0), "max_run_stroke", "ran on by"),
                (still, "max_motion_stroke", "still moved by"),
            ):
                limit = ctx.tolerance(name, joint)
                text = f"{what} {far:.3f} {ctx.unit} after it was locked"
                # a late lock extends the run-out
                by = (far - limit) / speed if speed else None
                yield Figure(far, begin, None, joint, text, limit=limit, late=by)


_SPEED_S = 0.02  # s over which a speed is taken


def _top_speed(t: Floats, q: Floats) -> float:
    """The largest speed of a joint, rad/s."""
    later = np.searchsorted(t, t + _SPEED_S)
    ahead = later < len(t)
    if not ahead.any():
        return 0.0
    rows = np.flatnonzero(ahead)
    then = later[ahead]
    return float((np.abs(q[then] - q[rows]) / (t[then] - t[rows])).max())


def _delay(ctx: Context, begin: float, end: float) -> float:
    """Seconds from the command of the step that led into [begin, end] until a joint moves."""
    commands = ctx.commands
    rows = np.flatnonzero((commands.t > begin - 0.3) & (commands.t <= end))
    if not len(rows):
        return 0.0
    same = rows[(commands.q[rows] == commands.q[rows[-1]]).all(axis=1)]
    given = float(commands.t[same[0]])
    before = ctx.q(given - 0.05, given)
    after = ctx.states.between(given, end)
    if not len(before):
        return 0.0
    strokes = np.array([j.stroke for j in ctx.joints])
    away = np.abs(ctx.states.q[after] - np.median(before, axis=0)) / strokes
    moves = (away > _MOVES).any(axis=1)
    return float(ctx.states.t[after][np.argmax(moves)]) - given if moves.any() else 0.0


_MOVES = 0.01  # of the stroke


@check("DEX3-MODE-07")
def unknown_status(ctx: Context) -> Outcome:
    """Commands with an undefined status in their mode bytes."""
    return stays(ctx, "commands with an unknown status in the mode byte")


# ---------------------------------------------------------------------------------------- force


_FORCE_S, _HELD = 0.3, 0.2  # s over which a force is taken, and the part of it that is below it
_STANDS = 0.03  # part of the range: a joint that moves by less meanwhile stands


def _first_force(ctx: Context, begin: float, end: float) -> tuple[Floats, Floats]:
    """tau_est in size of each joint in the first piece in which it stands, and that piece's end.

    A joint that is still on its way presses on nothing: its torque ends with its motion. 0 N m for
    one that never stands.
    """
    strokes = np.array([j.stroke for j in ctx.joints])
    felt, since = np.zeros(len(strokes)), np.full(len(strokes), np.inf)
    for at in np.arange(begin, end - _FORCE_S + 1e-9, _FORCE_S / 3).tolist():
        rows = ctx.states.between(at, at + _FORCE_S)
        q = ctx.states.q[rows]
        if not len(q):
            continue
        stands = np.isinf(since) & (np.ptp(q, axis=0) <= _STANDS * strokes)
        felt[stands] = np.median(np.abs(ctx.states.tau[rows]), axis=0)[stands]
        since[stands] = at + _FORCE_S
    return felt, since


@check("DEX3-FORCE-06")
@with_object
@worst("part", "min_part", nothing="no joint pressed on the object for long enough")
def keeps_gripping(ctx: Context) -> Figures:
    """The smallest tau_est later in a long grip, relative to its beginning.

    A value that a fifth of the states do not reach does not count as held, since a chattering limit
    lets go as often.
    """
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        if end - begin < ctx.tolerance("min_hold_s"):
            continue
        # the motors' own time-outs are a second after the last command
        quiet = [p for p in ctx.phases("guard") if p.begin_ns >= phase.end_ns]
        until = ctx.span(quiet[0])[0] + 0.7 if quiet else end
        first, since = _first_force(ctx, begin + _FORCE_S, end - _FORCE_S)
        least = ctx.tolerance("min_tau_nm")
        pressing = np.flatnonzero(first / torque_scales(ctx, least) >= least).tolist()
        later = np.arange(begin + 2 * _FORCE_S, end - _FORCE_S, _FORCE_S).tolist()
        spans = [*((at, at + _FORCE_S) for at in later), (end - _FORCE_S, end)]
        spans.append((until - _FORCE_S, until))
        for a, b in spans:
            tau = ctx.tau(a, b)
            if not len(tau):
                continue
            held = np.quantile(np.abs(tau), _HELD, axis=0)
            for joint in (j for j in pressing if a >= since[j] - 1e-9):
                then, now = float(first[joint]), float(held[joint])
                text = f"tau_est of {then:.2f} N m at first, and of {now:.2f} N m later"
                limit = ctx.tolerance("min_part") * then
                measure = Measure(now, limit, "N m", Quantity.TORQUE, False)
                yield Figure(now / then, a, b, joint, text, measure=measure)


# ----------------------------------------------------------------------------------- low rate


@check("DEX3-TOPIC-04")
def low_rate_is_fresh(ctx: Context) -> Outcome:
    """Whether each state of the low-rate topic equals a recent one of the fast topic."""
    slow, fast = ctx.recording.low_rate.get(ctx.side), ctx.states
    if slow is None or not len(slow) or not len(fast):
        return ctx.absent("there is no low-rate topic")
    age = ctx.tolerance("max_age_s")
    margin = np.array([ctx.tolerance("margin_stroke", j) for j in range(len(ctx.joints))])
    odd: list[tuple[float, int, str]] = []
    judged = 0
    for i, t in enumerate(slow.t.tolist()):
        rows = fast.between(t - age, t + _AHEAD_S)
        q, mode = fast.q[rows], fast.mode[rows]
        if len(q) < 3 or not np.isfinite(q).all():
            continue
        judged += 1
        with np.errstate(invalid="ignore"):
            away = np.maximum(q.min(axis=0) - slow.q[i], slow.q[i] - q.max(axis=0))
            other = (mode.min(axis=0) > slow.mode[i]) | (mode.max(axis=0) < slow.mode[i])
        off = ~(away <= margin)
        if off.any():
            joint = int(np.argmax(np.nan_to_num(away / margin, nan=np.inf)))
            text = f"q is {away[joint]:.2f} {ctx.unit} from all of the fast topic within {age:g} s"
            odd.append((t, joint, text))
        elif other.any():
            joint = int(np.argmax(other))
            text = f"mode is {slow.mode[i, joint]:g}, which the fast topic did not have"
            odd.append((t, joint, text))
    if judged < 3:
        return ctx.skipped("too few states on the low-rate topic beside those on the fast one")
    if len(odd) < ctx.tolerance("min_odd"):
        return ctx.passed(f"{judged} states", f"{judged} states on {slow.topic}, all as fast ones")
    _, joint, what = odd[0]
    text = ctx.named(f"{what}; so in {len(odd)} of {judged} states on {slow.topic}", joint)
    outcome = ctx.failed(
        f"{len(odd)} of {judged}", text, *(ctx.at(slow.topic, t) for t, *_ in odd[:5])
    )
    return outcome.about(joint).if_late(age)


@check("DEX3-TOPIC-05")
def low_rate_goes_on(ctx: Context) -> Outcome:
    """The longest time without a state on the low-rate topic while the fast one had states."""
    slow, fast = ctx.recording.low_rate.get(ctx.side), ctx.states
    if slow is None or len(slow) < 3 or not len(fast):
        return ctx.absent("there is no low-rate topic")
    gap, at = gap_beside_states(slow.t, fast.t)
    text = f"no state on {slow.topic} for {gap:.2f} s, while the fast topic had states"
    figure = Figure(gap, at, at + gap, text=text, topic=slow.topic)
    return judged(ctx, [figure], "gap_s", "max_gap_s", nothing="")


_AHEAD_S = 0.05  # s by which the low-rate topic may be received before the fast one
