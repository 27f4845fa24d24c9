"""Check a gripper's stiffness: displacement by a torque, and force on an object.

A position-controlled gripper is a spring of stiffness kp. The displacement by a torque without
contact gives its stiffness; on an object it must press with the same stiffness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.consistency import contacts
from dexkit.conformance.checks.figures import Figure, Figures, judged, with_object, worst
from dexkit.conformance.checks.grip import pressed
from dexkit.conformance.checks.motion import noise_at_rest
from dexkit.conformance.measurement_error import Measure, Quantity
from dexkit.conformance.median import median
from dexkit.conformance.stimulus_record import Phase
from dexkit.hand import Floats

__all__ = ["Nudge", "has_own_force", "nudges"]

STIFFNESS = "stiffness"
"""The phase of the pushes that are repeated throughout a run."""
_RESTS_PART = 0.005
"""Part of the stroke by which q may vary at rest."""
_MEDIAN_OFF = 0.7
"""Part of the noise of q by which its median in 0.1 s may be off, if 15 of the states are measured
and the others predicted from them: once in some hundred."""
_MOST_OFF_PART = 0.5
"""Part of a displacement that dry friction may take from it."""
_PEAKS_S, _FEW_PEAKS = 1.05, 3
"""Window of contact in which peaks are counted, seconds, and the fewest peaks of a failure."""


@dataclass(frozen=True)
class Nudge:
    """A torque pulse on a position-controlled gripper.

    :param way: displacement by the torque, rad; ``asked`` is torque / kp.
    :param at_rest: whether the gripper stood still before it.
    :param off: how far from its goal it was then, in the direction of the torque, rad: with dry
        friction it rests anywhere near the goal, and the torque displaces it by as much less.
    """

    begin: float
    end: float
    way: float
    asked: float
    at_rest: bool
    off: float = 0.0


def nudges(ctx: Context, phases: list[Phase] | None = None) -> list[Nudge]:
    """The torque pulses of these phases, by default of the phases that the requirement needs."""
    found = []
    for phase in ctx.phases() if phases is None else phases:
        begin, end = ctx.span(phase)
        before, after = ctx.q(begin - 0.15, begin)[:, 0], ctx.q(end - 0.1, end)[:, 0]
        given = (ctx.commands.t >= begin) & (ctx.commands.t < end)
        if not len(before) or not len(after) or not given.any():
            continue
        kp, tau = median(ctx.commands.kp[given, 0]), median(ctx.commands.tau[given, 0])
        if kp > 0 and tau != 0:  # a damaged recording may hold another command here
            sign = 1 if tau > 0 else -1
            way = (median(after) - median(before)) * sign
            off = (median(before) - median(ctx.commands.q[given, 0])) * sign
            rests = float(np.ptp(before)) <= _RESTS_PART * ctx.joints[0].stroke
            found.append(Nudge(begin, end, way, abs(tau) / kp, rests, off))
    return found


def displacement_noise(ctx: Context, phases: Sequence[Phase]) -> float:
    """By how much the noise of q may change a displacement by a torque in these phases, rad."""
    return _MEDIAN_OFF * noise_at_rest(ctx, 0, phases)


def is_alike(first: Nudge, last: Nudge, parts: tuple[float, float], noise: float) -> bool:
    """Whether a displacement is like an earlier one, give or take the noise of both, and that they
    began at other distances from the goal.

    :param parts: least and most of ``last``, as parts of ``first``.
    :param noise: of a displacement, rad.
    """
    low, high = parts[0] * (first.way - noise), parts[1] * (first.way + noise)
    slack = noise + min(abs(first.off - last.off), _MOST_OFF_PART * first.asked)
    return low - slack <= last.way <= high + slack


def has_own_force(ctx: Context) -> bool:
    """Whether no torque displaced the held gripper: a position servo, which uses q alone."""
    found = nudges(ctx, [*ctx.phases(STIFFNESS), *ctx.phases("nudge")])
    least = ctx.tolerance("min_motion_stroke")
    return bool(found) and not any(n.way >= least for n in found)


@check("DEX1-HOLD-01")
def held(ctx: Context) -> Outcome:
    """The displacement by a torque after a long hold, compared with that before it."""
    found = nudges(ctx)
    if len(found) < 2:
        return ctx.skipped("no state during two pushes")
    least, most = ctx.tolerance("min_part"), ctx.tolerance("max_part")
    shown = [n for n in found if n.way >= ctx.tolerance("min_motion_stroke")]
    if not shown:
        return ctx.skipped(
            "a torque does not displace this hand: it does not show whether it holds"
        )
    noise = displacement_noise(ctx, ctx.phases())
    pairs = [(a, b) for a, b in zip(found[::2], found[1::2], strict=False) if a in shown]
    for first, last in pairs:
        text = (
            f"a torque displaced it by {first.way:.3f} {ctx.unit}, and after "
            f"{last.begin - first.end:.1f} "
            f"s of equal commands by {last.way:.3f} {ctx.unit}"
        )
        if not is_alike(first, last, (least, most), noise):
            place = ctx.at(ctx.states.topic, last.begin, last.end)
            return ctx.failed(f"{last.way:.3f} {ctx.unit}", text, place, motion_rad=last.way)
    if not pairs:
        return ctx.skipped("the first push displaced it too little to compare the last with it")
    return ctx.passed(f"{last.way:.3f} {ctx.unit}", text, motion_rad=last.way)


@check("DEX1-GAIN-05")
@worst("part", "max_part", nothing="no state while it was pushed")
def stiffness(ctx: Context) -> Figures:
    """The largest displacement by a torque, relative to torque / kp."""
    for nudge in nudges(ctx, [*ctx.phases(), *ctx.phases(STIFFNESS)]):
        limit = ctx.tolerance("max_part") * nudge.asked
        yield Figure(
            nudge.way / nudge.asked,
            nudge.begin,
            nudge.end,
            text=f"a torque displaced it by {nudge.way:.3f} {ctx.unit}, through kp by "
            f"{nudge.asked:.3f} {ctx.unit}",
            measure=Measure(nudge.way, limit, "rad", Quantity.POSITION),
        )


@dataclass(frozen=True)
class _Peak:
    """A piece of contact, and the states in which tau_est is above its limit, N m."""

    begin: float
    end: float
    states: int
    count: int
    limit: float
    above: Floats


def _hammers(ctx: Context, peaks: list[_Peak]) -> Outcome | None:
    """The failure of a hand with repeated short peaks of force."""
    for i, first in enumerate(peaks):
        near = [p for p in peaks[i:] if p.end - first.begin <= _PEAKS_S]
        count, states = sum(p.count for p in near), sum(p.states for p in near)
        if count >= _FEW_PEAKS and count > ctx.tolerance("max_peaks_part") * states:
            hit = next(p for p in near if p.count)
            tau = float(hit.above.max())
            text = (
                f"tau_est of {tau:.2f} N m in contact in {count} of {states} states, where at most "
                f"{hit.limit:.2f} N m follow from the stiffness that it shows without contact"
            )
            place = ctx.at(ctx.states.topic, near[0].begin, near[-1].end)
            outcome = ctx.failed(f"{tau:.2f} N m", text, place, tau_nm=tau)
            return outcome.pressed(tau, hit.limit)
    return None


@check("DEX1-FORCE-18")
@with_object
def contact_force_fits_stiffness(ctx: Context) -> Outcome:
    """tau_est of each piece of contact, relative to the hand's measured stiffness times the
    error.
    """
    found = nudges(ctx, [*ctx.phases(), *ctx.phases("nudge")])
    shown = [n for n in found if n.way >= ctx.tolerance("min_motion_stroke")]
    if not found:
        return ctx.skipped("no state while it was pushed")
    if len(shown) < len(found):
        return ctx.skipped("a torque does not displace this hand: it has a force of its own")
    # relative to kp; a stiffer hand may press more, and a softer one less
    stiffest = max(1.0, *(n.asked / n.way for n in shown))
    softest = min(1.0, *(n.asked / n.way for n in shown))
    least, most = ctx.tolerance("min_part"), ctx.tolerance("max_part")
    text = "tau_est of {felt} in contact, where {limit} follow from the stiffness that it shows "
    text += "without contact"
    figures: list[Figure] = []
    peaks: list[_Peak] = []
    for piece in contacts(ctx, ctx.touch):
        asked = piece.kp * (piece.q - piece.goal)
        if asked < ctx.tolerance("min_asked_nm"):
            continue
        low = least * softest * min(asked, ctx.tolerance("max_asked_nm"))
        high = most * stiffest * asked
        span = piece.begin, piece.end
        figures += pressed((piece.tau, piece.tau), (low, high), text, *span)
        felt = np.abs(ctx.tau(*span)[:, 0])
        peak = most * stiffest * piece.most
        above = felt[felt > peak]
        peaks.append(_Peak(*span, len(felt), len(above), peak, above))
    nothing = "it never pressed on the object for long enough"
    outcome = judged(ctx, figures, "tau_nm", "max_tau_nm", nothing=nothing)
    return _hammers(ctx, peaks) or outcome if outcome.met else outcome
