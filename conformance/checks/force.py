"""Check tau_est of a gripper: in contact, at rest, and its sign."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import ROUNDING, Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, Figures, with_object, worst
from dexkit.conformance.checks.firmness import has_own_force
from dexkit.conformance.checks.motion import obeyed_before
from dexkit.conformance.measurement_error import Measure, Quantity
from dexkit.conformance.median import median, medians
from dexkit.conformance.results import Evidence
from dexkit.conformance.stimulus_record import Phase
from dexkit.hand import Floats
from dexkit.models import HandModel

Ranges: TypeAlias = NDArray[np.intp]
"""Rows from the first to before the second, shape (n, 2)."""


def squeezes(ctx: Context) -> tuple[float, float] | None:
    """(begin, end) of the last half second of the last squeeze that has states."""
    for phase in reversed(ctx.phases()):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.5)
        tau = ctx.tau(begin, end)
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
    tau = ctx.tau(*span)[:, 0]
    begin = next(b for b, e in map(ctx.span, reversed(ctx.phases())) if e == span[1])
    return float(np.median(tau[np.isfinite(tau)])), begin, span[1]


@check("DEX1-FORCE-01")
@with_object
@worst("tau_nm", "min_tau_nm", nothing="no state while it squeezed")
def in_contact(ctx: Context) -> Figures:
    """tau_est in size while squeezing an object."""
    found = _squeeze(ctx)
    if found is not None:
        tau, begin, end = found
        yield Figure(abs(tau), begin, end, text=f"tau_est {tau:.3f} N m while squeezing")


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
        tau = np.abs(ctx.tau(float(at), float(at) + window)[:, 0])
        tau = np.sort(tau[np.isfinite(tau)])
        if len(tau) >= 3:
            found.append((float(at), median(tau), float(tau[int(_HELD * len(tau))])))
    return found


@check("DEX1-FORCE-10")
@with_object
@worst("change_part", "max_change_part", nothing="it did not press on the object for long enough")
def lasts(ctx: Context) -> Figures:
    """Rise and fall of the force of a long grip under a constant command."""
    window = ctx.tolerance("window_s")
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
                if was == least or at >= settled:
                    text = f"tau_est of {now:.2f} N m {at - begin:.1f} s after the command, where "
                    yield Figure(change, at, at + window, text=f"{text}it was {was:.2f}")


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
@with_object
@worst("part", "min_part", nothing="no state during a later grip")
def again(ctx: Context) -> Figures:
    """The smallest force of later grips, relative to the first."""
    grips = ctx.phases("grip")
    first = _force(ctx, grips[0]) if grips else None
    if first is None or first < ctx.tolerance("min_tau_nm"):
        yield ctx.skipped("it did not grip before")
        return
    # a driver may lower its effort at first (DEX1-FORCE-10): the least of the first grip's end
    begin, end = ctx.span(grips[0])
    pieces = _felt(ctx, max(begin, end - 0.5), end, 0.1)
    first = max(min((tau for _, tau, _ in pieces), default=first), ctx.tolerance("min_tau_nm"))
    for phase in (*grips[1:], *ctx.phases(), *ctx.phases("regrip")):
        tau = _force(ctx, phase)
        if tau is not None and obeyed_before(ctx, phase):
            text = f"tau_est of {tau:.2f} N m in a later grip, {first:.2f} N m in the first"
            least = ctx.tolerance("min_part") * first
            measure = Measure(tau, least, "N m", Quantity.TORQUE, False)
            yield Figure(tau / first, *ctx.span(phase), text=text, measure=measure)


def _force(ctx: Context, phase: Phase) -> float | None:
    """The median abs(tau_est) of the last half second of a grip; None without states."""
    begin, end = ctx.span(phase)
    tau = np.abs(ctx.tau(max(begin, end - 0.5), end)[:, 0])
    tau = tau[np.isfinite(tau)]
    return median(tau) if len(tau) else None


@dataclass(frozen=True)
class _Grip:
    """The end of a grip with another stiffness than the client's.

    :param tau: median abs(tau_est), N m.
    :param asked: the torque that its command asks for, N m.
    """

    tau: float
    asked: float
    kp: float
    begin: float
    end: float

    @property
    def part(self) -> float:
        """Its torque relative to the commanded one."""
        return self.tau / self.asked


@check("DEX1-FORCE-11")
@with_object
@worst("tau_nm", "min_tau_nm", nothing="no state during grips with little stiffness")
def soft_grips(ctx: Context) -> Figures:
    """The smallest tau_est of grips with low stiffness."""
    for grip in _soft(ctx):
        text = (
            f"tau_est of {grip.tau:.2f} N m with a kp of {grip.kp:g} N m/rad, where kp times the "
            f"distance is {grip.asked:.2f} N m"
        )
        yield Figure(grip.tau, grip.begin, grip.end, text=text)


def _soft(ctx: Context) -> list[_Grip]:
    """The soft grips that ask for enough torque to tell."""
    found = []
    for phase in ctx.phases("soft-grip"):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.3)
        given = ctx.given(begin, end)
        tau, q = np.abs(ctx.tau(begin, end)[:, 0]), ctx.q(begin, end)[:, 0]
        if not given.any() or not (np.isfinite(tau) & np.isfinite(q)).any():
            continue
        kp = median(ctx.commands.kp[given, 0])
        asked = kp * (median(q) - median(ctx.commands.q[given, 0]))
        if asked >= ctx.tolerance("min_asked_nm"):
            found.append(_Grip(median(tau), asked, kp, begin, end))
    return found


def _softer(ctx: Context) -> list[_Grip]:
    """The grips of :func:`_soft` with less stiffness than the client's; with more, a coarse goal
    has a large effect.
    """
    hand = ctx.recording.model
    assert isinstance(hand, HandModel)  # a robot grips nothing
    return [grip for grip in _soft(ctx) if grip.kp < hand.gains[0][0]]


_OWN = "this gripper has a force of its own"


def _usual(ctx: Context) -> float | None:
    """The force of a grip with the client's stiffness, relative to the commanded one."""
    stiff = []
    for phase in ctx.phases("grip"):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.5)
        given = ctx.given(begin, end)
        if given.any() and len(ctx.q(begin, end)):
            away = median(ctx.q(begin, end)[:, 0]) - median(ctx.commands.q[given, 0])
            wanted = median(ctx.commands.kp[given, 0]) * away
            if wanted >= ctx.tolerance("min_asked_nm"):
                stiff.append(median(np.abs(ctx.tau(begin, end)[:, 0])) / wanted)
    return min(stiff) if stiff else None


@check("DEX1-FORCE-12")
@worst("change", "max_change_part", nothing="no grips with little stiffness")
def in_proportion(ctx: Context) -> Figures:
    """The force of soft grips compared with a stiff one, each relative to the commanded force."""
    usual, part = _usual(ctx), ctx.tolerance("max_change_part")
    for grip in _softer(ctx):
        if usual is None:
            yield ctx.skipped("no grip with the client's stiffness")
        elif abs(usual - 1.0) > part or has_own_force(ctx):
            yield ctx.skipped(_OWN)
        else:
            text = (
                f"tau_est of {grip.tau:.2f} N m with a kp of {grip.kp:g} N m/rad, where kp times "
                f"the distance is {grip.asked:.2f} N m; with the client's kp it is {usual:.0%} of "
                "that"
            )
            change, shown = abs(grip.part - 1.0), f"{grip.part:.0%}"
            yield Figure(change, grip.begin, grip.end, text=text, shown=shown)


@check("DEX1-FORCE-14")
@worst("part", "max_part", nothing="no grips to compare, one of them with the client's stiffness")
def no_more_than_asked(ctx: Context) -> Figures:
    """The greatest force of soft grips, relative to the commanded one."""
    soft, usual = _softer(ctx), _usual(ctx)
    if not soft or usual is None:
        return
    if abs(usual - 1.0) > ctx.tolerance("max_own_part") or has_own_force(ctx):
        yield ctx.skipped(_OWN)
    for grip in soft:
        text = (
            f"tau_est of {grip.tau:.2f} N m with a kp of {grip.kp:g} N m/rad, which asks for "
            f"{grip.asked:.2f} N m"
        )
        limit = ctx.tolerance("max_part") * grip.asked
        measure = Measure(grip.tau, limit, "N m", Quantity.TORQUE)
        yield Figure(grip.part, grip.begin, grip.end, text=text, measure=measure)


@check("DEX1-FORCE-15")
@with_object
@worst("part", "max_part", nothing="no force was reported while it squeezed")
def releases_with_zero_gains(ctx: Context) -> Figures:
    """tau_est after zero gains at the q of a grip, relative to that of the grip."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, after = (
            np.abs(tau[np.isfinite(tau)])
            for tau in (ctx.tau(begin - 0.3, begin)[:, 0], ctx.tau(end - 0.1, end)[:, 0])
        )
        if len(before) < 3 or len(after) < 3 or median(before) < ctx.tolerance("min_tau_nm"):
            continue
        left, had = median(after), median(before)
        text = f"tau_est {left:.2f} N m after zero gains at the same q, {had:.2f} N m before"
        measure = Measure(left, ctx.tolerance("max_part") * had, "N m", Quantity.TORQUE)
        yield Figure(left / had, begin, end, text=text, measure=measure)


@check("DEX1-FORCE-13")
@worst("tau_nm", "max_tau_nm", nothing="it was never without contact before the first command")
def zero(ctx: Context) -> Figures:
    """The median of tau_est, in size, without contact, before the first command."""
    if (unknown := ctx.contact_unknown) is not None:
        yield unknown
    states, asked = ctx.states, ctx.commands.t
    q, tau = states.q[:, 0], states.tau[:, 0]
    ends = ctx.tolerance("clear_stroke")
    low = (ctx.joints[0].q_min if ctx.object_at is None else ctx.object_at) + ends
    with np.errstate(invalid="ignore"):
        free = np.isfinite(tau) & (q > low) & (q < ctx.joints[0].q_max - ends)
    if len(asked):
        free &= states.t < asked[0]
    if int(free.sum()) >= 20:
        level = median(tau[free])
        text = f"tau_est of {level:.3f} N m before the first command"
        yield Figure(abs(level), float(states.t[free][0]), text=text)


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
@worst("tau_nm", "max_tau_nm", nothing="the gripper never rests at its target in this recording")
def at_rest(ctx: Context) -> Figures:
    """tau_est while the gripper rests at its target without contact."""
    states, commands = ctx.states, ctx.commands
    if (unknown := ctx.contact_unknown) is not None:
        yield unknown
    if len(commands) < 2:
        yield ctx.skipped("no commands to this hand")
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
    if taus:
        # the median of all rests: one of them may be an unannounced contact
        level, begin = sorted(taus)[len(taus) // 2]
        text = f"tau_est {level:.3f} N m at rest (median of {len(taus)} rests)"
        yield Figure(level, begin, begin + window, text=text)


@check("DEX1-FORCE-03")
@with_object
def sign(ctx: Context) -> Outcome:
    """Sign of tau_est while squeezing."""
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
@worst("tau_nm", "max_below_nm", nothing="no state with a tau_est")
def unsigned(ctx: Context) -> Figures:
    """The smallest tau_est in a dialect where it is the strength of the grip."""
    tau = ctx.states.tau[:, 0]
    if np.isfinite(tau).any():
        i = int(np.nanargmin(tau))
        text = f"tau_est from {tau[i]:.2f} to {float(np.nanmax(tau)):.2f} N m"
        limit, shown = ctx.tolerance("min_tau_nm"), f"{tau[i]:.2f} N m"
        at = float(ctx.states.t[i])
        yield Figure(-float(tau[i]), at, text=text, limit=limit, shown=shown)
