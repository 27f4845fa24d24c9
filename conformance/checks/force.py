"""Check tau_est of a gripper: in contact, at rest, and its sign."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import ROUNDING, Context, Outcome, check
from dexkit.conformance.checks.firmness import has_own_force
from dexkit.conformance.checks.motion import obeyed_before
from dexkit.conformance.median import median, medians
from dexkit.conformance.results import Evidence
from dexkit.hand import Floats
from dexkit.models import HandModel

Ranges: TypeAlias = NDArray[np.intp]
"""Rows from the first to before the second, shape (n, 2)."""


def squeezes(ctx: Context) -> tuple[float, float] | None:
    """(begin, end) of the last half second of the last squeeze that has states."""
    for phase in reversed(ctx.phases()):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.5)
        tau = ctx.states.tau[ctx.states.between(begin, end)]
        if np.isfinite(tau).all(axis=1).any():
            return begin, end
    return None


def _squeeze(ctx: Context) -> tuple[float, float, float] | None:
    """(median tau_est of the last half second, begin, end) of a squeeze.

    The failure's place is the whole phase, because an overload before the last half second delays
    the contact too.
    """
    span = squeezes(ctx)
    if span is None:
        return None
    tau = ctx.states.tau[ctx.states.between(*span), 0]
    begin = next(b for b, e in map(ctx.span, reversed(ctx.phases())) if e == span[1])
    return float(np.median(tau[np.isfinite(tau)])), begin, span[1]


@check("DEX1-FORCE-01")
def in_contact(ctx: Context) -> Outcome:
    """tau_est while squeezing an object."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    found = _squeeze(ctx)
    if found is None:
        return ctx.skipped("no state while it squeezed")
    tau, begin, end = found
    text = f"tau_est {tau:.3f} N m while squeezing"
    limit = ctx.tolerance("min_tau_nm")
    if abs(tau) >= limit:
        met = ctx.passed(f"{tau:.2f} N m", text, tau_nm=tau)
        return met.pressed(abs(tau), limit, at_least=True)
    place = ctx.at(ctx.states.topic, begin, end)
    outcome = ctx.failed(f"{tau:.2f} N m", text, place, tau_nm=tau)
    return outcome.pressed(abs(tau), limit, at_least=True)


_HELD = 0.2
"""Quantile of tau_est that counts as held: a chattering limit lets go half of the time."""


def _felt(
    ctx: Context, begin: float, end: float, window: float
) -> list[tuple[float, float, float]]:
    """(time, median abs(tau_est), held abs(tau_est)) of consecutive windows.

    Windows without states are left out.
    """
    found = []
    for at in np.arange(begin, end - window + 1e-9, window):
        tau = np.abs(ctx.states.tau[ctx.states.between(float(at), float(at) + window), 0])
        tau = np.sort(tau[np.isfinite(tau)])
        if len(tau) >= 3:
            found.append((float(at), median(tau), float(tau[int(_HELD * len(tau))])))
    return found


@check("DEX1-FORCE-10")
def lasts(ctx: Context) -> Outcome:
    """Rise and fall of the force of a long grip under a constant command."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    window = ctx.tolerance("window_s")
    worst: tuple[float, float, float, float, float] | None = None
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        touched = _touched(ctx, begin, end)
        if touched is None:
            continue
        felt = _felt(ctx, touched + ctx.tolerance("contact_s"), end, window)
        settled = touched + ctx.tolerance("settle_s")
        usual = [tau for at, tau, _ in felt if at >= settled][:3]
        if len(usual) < 3 or median(np.array(usual)) < ctx.tolerance("min_tau_nm"):
            continue
        # a driver may lower its effort at first, but no force may grow
        held, least = median(np.array(usual)), felt[0][1]
        for at, tau, kept in felt:
            least = max(min(least, tau), ctx.tolerance("min_tau_nm"))
            for now, was, change in (
                (tau, least, tau / least - 1.0),
                (kept, held, 1.0 - kept / held),
            ):
                counts = was == least or at >= settled
                if counts and (worst is None or change > worst[0]):
                    worst = change, at, now, was, begin
    if worst is None:
        return ctx.skipped("it did not press on the object for long enough")
    change, at, tau, was, begin = worst
    text = f"tau_est of {tau:.2f} N m {at - begin:.1f} s after the command, where it was {was:.2f}"
    if change <= ctx.tolerance("max_change_part"):
        return ctx.passed(f"{change:.0%}", text, change_part=change)
    place = ctx.at(ctx.states.topic, at, at + window)
    return ctx.failed(f"{tau:.2f} N m", text, place, change_part=change)


def _touched(ctx: Context, begin: float, end: float) -> float | None:
    """Time at which a gripper reached its final position, s; None without states."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows, 0]
    good = np.isfinite(q)
    t, q = t[good], q[good]
    if len(q) < 10:
        return None
    last = median(q[t >= end - 0.5]) if (t >= end - 0.5).any() else float(q[-1])
    there = np.abs(q - last) <= ctx.tolerance("near_stroke")
    return float(t[np.argmax(there)]) if there.any() else None


@check("DEX1-FORCE-17")
def again(ctx: Context) -> Outcome:
    """The smallest force of later grips, relative to the first."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")

    def force(begin: float, end: float) -> float | None:
        tau = np.abs(ctx.states.tau[ctx.states.between(max(begin, end - 0.5), end), 0])
        tau = tau[np.isfinite(tau)]
        return median(tau) if len(tau) else None

    grips = ctx.phases("grip")
    first = force(*ctx.span(grips[0])) if grips else None
    if first is None or first < ctx.tolerance("min_tau_nm"):
        return ctx.skipped("it did not grip before")
    # a driver may lower its effort at first (DEX1-FORCE-10): the least of the first grip's end
    begin, end = ctx.span(grips[0])
    pieces = _felt(ctx, max(begin, end - 0.5), end, 0.1)
    first = max(min((tau for _, tau, _ in pieces), default=first), ctx.tolerance("min_tau_nm"))
    judged = [
        p for p in (*grips[1:], *ctx.phases(), *ctx.phases("regrip")) if obeyed_before(ctx, p)
    ]
    later = [(tau, *s) for s in map(ctx.span, judged) if (tau := force(*s)) is not None]
    if not later:
        return ctx.skipped("no state during a later grip")
    tau, begin, end = min(later)
    limit = ctx.tolerance("min_part") * first
    text = f"tau_est of {tau:.2f} N m in a later grip, {first:.2f} N m in the first"
    if tau >= limit:
        met = ctx.passed(f"{tau / first:.0%}", text, part=tau / first)
        return met.pressed(tau, limit, at_least=True)
    place = ctx.at(ctx.states.topic, begin, end)
    outcome = ctx.failed(f"{tau / first:.0%}", text, place, part=tau / first)
    return outcome.pressed(tau, limit, at_least=True)


@check("DEX1-FORCE-11")
def soft_grips(ctx: Context) -> Outcome:
    """The smallest tau_est of grips with low stiffness."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    found = _soft(ctx)
    if not found:
        return ctx.skipped("no state during grips with little stiffness")
    _, tau, asked, kp, begin, end = min(found, key=lambda f: f[1])
    text = (
        f"tau_est of {tau:.2f} N m with a kp of {kp:g} N m/rad, where kp times the distance is "
        f"{asked:.2f} N m"
    )
    limit = ctx.tolerance("min_tau_nm")
    if tau >= limit:
        met = ctx.passed(f"{tau:.2f} N m", text, tau_nm=tau)
        return met.pressed(tau, limit, at_least=True)
    outcome = ctx.failed(f"{tau:.2f} N m", text, ctx.at(ctx.states.topic, begin, end), tau_nm=tau)
    return outcome.pressed(tau, limit, at_least=True)


def _soft(ctx: Context) -> list[tuple[float, float, float, float, float, float]]:
    """(part, tau_est, torque asked for, kp, begin, end) of the end of each soft grip."""
    found = []
    for phase in ctx.phases("soft-grip"):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.3)
        rows = ctx.states.between(begin, end)
        asked = (ctx.commands.t >= begin) & (ctx.commands.t <= end)
        tau, q = np.abs(ctx.states.tau[rows, 0]), ctx.states.q[rows, 0]
        if not asked.any() or not (np.isfinite(tau) & np.isfinite(q)).any():
            continue
        kp = median(ctx.commands.kp[asked, 0])
        wanted = kp * (median(q) - median(ctx.commands.q[asked, 0]))
        if wanted >= ctx.tolerance("min_asked_nm"):
            felt = median(tau)
            found.append((felt / wanted, felt, wanted, kp, begin, end))
    return found


def _softer(ctx: Context) -> list[tuple[float, float, float, float, float, float]]:
    """The grips of :func:`_soft` with less stiffness than the client's; with more, a coarse goal
    has a large effect.
    """
    hand = ctx.recording.model
    assert isinstance(hand, HandModel)  # a robot grips nothing
    return [grip for grip in _soft(ctx) if grip[3] < hand.gains[0][0]]


_OWN = "this gripper has a force of its own"


def _usual(ctx: Context) -> float | None:
    """The force of a grip with the client's stiffness, relative to the commanded one."""
    stiff = []
    for phase in ctx.phases("grip"):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.5)
        rows = ctx.states.between(begin, end)
        asked = (ctx.commands.t >= begin) & (ctx.commands.t <= end)
        if asked.any() and len(ctx.states.t[rows]):
            away = median(ctx.states.q[rows, 0]) - median(ctx.commands.q[asked, 0])
            wanted = median(ctx.commands.kp[asked, 0]) * away
            if wanted >= ctx.tolerance("min_asked_nm"):
                stiff.append(median(np.abs(ctx.states.tau[rows, 0])) / wanted)
    return min(stiff) if stiff else None


@check("DEX1-FORCE-12")
def in_proportion(ctx: Context) -> Outcome:
    """The force of soft grips compared with a stiff one, each relative to the commanded force."""
    soft = _softer(ctx)
    if not soft:
        return ctx.skipped("no grips with little stiffness")
    usual, part = _usual(ctx), ctx.tolerance("max_change_part")
    if usual is None:
        return ctx.skipped("no grip with the client's stiffness")
    if abs(usual - 1.0) > part or has_own_force(ctx):
        return ctx.skipped(_OWN)
    worst = max(soft, key=lambda f: abs(f[0] - 1.0))
    ratio, tau, torque, kp, begin, end = worst
    text = (
        f"tau_est of {tau:.2f} N m with a kp of {kp:g} N m/rad, where kp times the distance is "
        f"{torque:.2f} N m; with the client's kp it is {usual:.0%} of that"
    )
    if abs(ratio - 1.0) <= part:
        return ctx.passed(f"{ratio:.0%}", text, part=ratio)
    return ctx.failed(f"{ratio:.0%}", text, ctx.at(ctx.states.topic, begin, end), part=ratio)


@check("DEX1-FORCE-14")
def no_more_than_asked(ctx: Context) -> Outcome:
    """The greatest force of soft grips, relative to the commanded one."""
    soft, usual = _softer(ctx), _usual(ctx)
    if not soft or usual is None:
        return ctx.skipped("no grips to compare, one of them with the client's stiffness")
    if abs(usual - 1.0) > ctx.tolerance("max_own_part") or has_own_force(ctx):
        return ctx.skipped(_OWN)
    ratio, tau, torque, kp, begin, end = max(soft)
    text = f"tau_est of {tau:.2f} N m with a kp of {kp:g} N m/rad, which asks for {torque:.2f} N m"
    limit = ctx.tolerance("max_part") * torque
    if tau <= limit:
        return ctx.passed(f"{ratio:.0%}", text, tau_nm=tau).pressed(tau, limit)
    outcome = ctx.failed(f"{tau:.2f} N m", text, ctx.at(ctx.states.topic, begin, end), tau_nm=tau)
    return outcome.pressed(tau, limit)


@check("DEX1-FORCE-15")
def releases_with_zero_gains(ctx: Context) -> Outcome:
    """tau_est after zero gains at the q of a grip, relative to that of the grip."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    worst: tuple[float, float, float, float, float] | None = None
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before = np.abs(ctx.states.tau[ctx.states.between(begin - 0.3, begin), 0])
        after = np.abs(ctx.states.tau[ctx.states.between(end - 0.1, end), 0])
        before, after = before[np.isfinite(before)], after[np.isfinite(after)]
        if len(before) < 3 or len(after) < 3 or median(before) < ctx.tolerance("min_tau_nm"):
            continue
        part = median(after) / median(before)
        if worst is None or part > worst[0]:
            worst = part, median(after), median(before), begin, end
    if worst is None:
        return ctx.skipped("no force was reported while it squeezed")
    part, left, had, begin, end = worst
    limit = ctx.tolerance("max_part") * had
    text = f"tau_est {left:.2f} N m after zero gains at the same q, {had:.2f} N m before"
    if left <= limit:
        return ctx.passed(f"{part:.0%}", text, tau_nm=left).pressed(left, limit)
    outcome = ctx.failed(f"{part:.0%}", text, ctx.at(ctx.states.topic, begin, end), tau_nm=left)
    return outcome.pressed(left, limit)


@check("DEX1-FORCE-13")
def zero(ctx: Context) -> Outcome:
    """The median of tau_est without contact, before the first command."""
    if (unknown := ctx.contact_unknown) is not None:
        return unknown
    states, asked = ctx.states, ctx.commands.t
    q, tau = states.q[:, 0], states.tau[:, 0]
    ends = ctx.tolerance("clear_stroke")
    low = (ctx.joints[0].q_min if ctx.object_at is None else ctx.object_at) + ends
    with np.errstate(invalid="ignore"):
        free = np.isfinite(tau) & (q > low) & (q < ctx.joints[0].q_max - ends)
    if len(asked):
        free &= states.t < asked[0]
    if int(free.sum()) < 20:
        return ctx.skipped("it was never without contact before the first command")
    level = median(tau[free])
    text = f"tau_est of {level:.3f} N m before the first command"
    limit = ctx.tolerance("max_tau_nm")
    if abs(level) <= limit:
        return ctx.passed(f"{level:.3f} N m", text, tau_nm=level).pressed(abs(level), limit)
    place = ctx.at(states.topic, float(states.t[free][0]))
    return ctx.failed(f"{level:.2f} N m", text, place, tau_nm=level).pressed(abs(level), limit)


def _ranges(t: Floats, begins: Floats, ends: Floats, side: Literal["left", "right"]) -> Ranges:
    """Rows of t in each interval: the first, and the first after it, shape (n, 2)."""
    return np.column_stack([np.searchsorted(t, begins), np.searchsorted(t, ends, side)])


def _bounds(values: Floats, ranges: Ranges) -> tuple[Floats, Floats]:
    """Lowest and highest value in each range, NaN if one of them is not a number.

    For an empty range, the value at its beginning.
    """
    longer = np.append(values, np.nan)  # an end may be one past the last row
    if not len(ranges):
        return np.empty(0), np.empty(0)
    low, high = (f.reduceat(longer, ranges.ravel())[::2] for f in (np.minimum, np.maximum))
    return low, high


def _still(ctx: Context) -> Floats:
    """Begins of the consecutive windows during the commands in which q does not change."""
    window, asked = ctx.tolerance("min_rest_s"), ctx.commands.t
    begins: Floats = np.asarray(np.arange(float(asked[0]), float(asked[-1]) - window, window))
    ranges = _ranges(ctx.states.t, begins, begins + window, "left")
    full = np.diff(ranges)[:, 0] >= 5
    low, high = _bounds(ctx.states.q[:, 0], ranges[full])
    return begins[full][high - low <= ctx.tolerance("max_ripple_stroke")]


@check("DEX1-FORCE-02")
def at_rest(ctx: Context) -> Outcome:
    """tau_est while the gripper rests at its target without contact."""
    states, commands = ctx.states, ctx.commands
    if (unknown := ctx.contact_unknown) is not None:
        return unknown
    if len(commands) < 2:
        return ctx.skipped("no commands to this hand")
    window = ctx.tolerance("min_rest_s")
    begins = _still(ctx)
    rows = _ranges(states.t, begins, begins + window, "right")
    asked = _ranges(commands.t, begins, begins + window, "left")
    low, high = _bounds(states.q[:, 0], rows)
    goal_low, goal_high = _bounds(commands.q[:, 0], asked)
    rests = (np.diff(rows)[:, 0] >= 5) & (np.diff(asked)[:, 0] >= 3)
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false
        rests &= high - low <= ctx.tolerance("max_ripple_stroke")
        rests &= goal_high - goal_low <= ctx.tolerance("max_ripple_stroke")
    rests &= _bounds(commands.kp[:, 0], asked)[0] > 0
    if ctx.object_at is not None:
        rests &= low > ctx.object_at + 0.1
    rows, asked, begins = rows[rests], asked[rests], begins[rests]
    errors = medians(states.q[:, 0], rows) - medians(commands.q[:, 0], asked)
    near = np.abs(errors) <= ctx.tolerance("max_error_stroke")
    sizes = medians(np.abs(states.tau[:, 0]), rows[near])
    taus = list(zip(sizes.tolist(), begins[near].tolist(), strict=True))
    if not taus:
        return ctx.skipped("the gripper never rests at its target in this recording")
    # the median of all rests: one of them may be an unannounced contact
    level, begin = sorted(taus)[len(taus) // 2]
    text = f"tau_est {level:.3f} N m at rest (median of {len(taus)} rests)"
    limit = ctx.tolerance("max_tau_nm")
    if level <= limit:
        return ctx.passed(f"{level:.3f} N m", text, tau_nm=level).pressed(level, limit)
    return ctx.failed(
        f"{level:.2f} N m", text, ctx.at(states.topic, begin, begin + window), tau_nm=level
    ).pressed(level, limit)


@check("DEX1-FORCE-03")
def sign(ctx: Context) -> Outcome:
    """Sign of tau_est while squeezing."""
    if ctx.object_at is None:
        return ctx.skipped("this hand was not given an object to squeeze (--object)")
    found = _squeeze(ctx)
    if found is None or found[0] == 0.0:
        return ctx.skipped("no force was reported while it squeezed")
    tau, begin, end = found
    text = f"tau_est {tau:+.3f} N m while closing on an object"
    if tau < 0:
        return ctx.passed("negative", text, tau_nm=tau)
    return ctx.failed("positive", text, ctx.at(ctx.states.topic, begin, end), tau_nm=tau)


@check("DEX1-FORCE-04", "DEX3-FORCE-02")
def unit(ctx: Context) -> Outcome:
    """The largest tau_est, relative to the joint's torque limit."""
    worst: tuple[float, float, int, float] = (0.0, 0.0, 0, 0.0)
    for joint, spec in enumerate(ctx.joints):
        tau = np.abs(ctx.states.tau[:, joint])
        if not np.isfinite(tau).any():
            continue
        i = int(np.nanargmax(tau))
        worst = max(worst, (float(tau[i]) / spec.tau_max, float(tau[i]), joint, ctx.states.t[i]))
    part, tau_nm, joint, at = worst
    text = ctx.named(f"|tau_est| of at most {tau_nm:.2f} N m", joint)
    if part <= ctx.tolerance("max_part") * (1.0 + ROUNDING):
        return ctx.passed(f"{tau_nm:.2f} N m", text, tau_nm=tau_nm)
    place = ctx.at(ctx.states.topic, float(at))
    if ctx.hand.has_raw_torque:
        return raw_counts(ctx, joint, tau_nm, place)
    return ctx.failed(f"{tau_nm:.3g} N m", text, place, tau_nm=tau_nm).about(joint)


def raw_counts(
    ctx: Context, joint: int, most: float, place: Evidence, unit: str = "N m"
) -> Outcome:
    """The outcome of a hand whose tau_est is in raw counts: no other requirement judges it."""
    text = ctx.named(f"|tau_est| of at most {most:.0f}: not {unit}, looks like raw counts", joint)
    outcome = ctx.failed(f"{most:.0f} counts", text, place).about(joint).tolerated()
    return outcome.because(
        f"tau_est holds the raw register, as some real hands do. Its force in {unit} is not known, "
        "and not judged."
    )


@check("DEX1-FORCE-05")
def unsigned(ctx: Context) -> Outcome:
    """The smallest tau_est in a dialect where it is the strength of the grip."""
    tau = ctx.states.tau[:, 0]
    if not np.isfinite(tau).any():
        return ctx.skipped("no state with a tau_est")
    i = int(np.nanargmin(tau))
    least = float(tau[i])
    text = f"tau_est from {least:.2f} to {float(np.nanmax(tau)):.2f} N m"
    if least >= -ctx.tolerance("min_tau_nm"):
        return ctx.passed(f"{least:.2f} N m", text, tau_nm=least)
    return ctx.failed(
        f"{least:.2f} N m", text, ctx.at(ctx.states.topic, float(ctx.states.t[i])), tau_nm=least
    )
