"""An operator with the client of xr_teleoperate moves the hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

from dexkit.conformance.checks import STROKE_S, Context, Outcome, check
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.stimuli.operator import OPERATOR, operator_of
from dexkit.hand import Side
from dexkit.teleop import client_for
from dexkit.teleop.tracking import Step, TrackingFigures, tracking_figures

_PART = 0.75
"""Part of its nominal rate that the modelled client must reach; below it the hand is not judged."""


@dataclass(frozen=True)
class _OperatorFigures:
    """Measured figures of one side.

    :param client_hz: commands a second of the client in the phase.
    :param joints: those of the joints that the operator moves, by index.
    """

    begin: float
    end: float
    client_hz: float
    joints: dict[int, TrackingFigures]


def _operator_figures(recording: Recording, side: Side) -> _OperatorFigures | str:
    phases = recording.phases(OPERATOR, side)
    if not phases:
        return "no operator in this recording"
    phase, hand = phases[0], recording.sides[side]
    begin, end = recording.seconds(phase.begin_ns), recording.seconds(phase.end_ns)
    sent = hand.commands.t[(hand.commands.t >= begin) & (hand.commands.t <= end)]
    if len(sent) < 2:
        return (
            "Unitree's client sent no command: it waits for a state that it can use, of each hand"
        )
    operator = operator_of(phase, recording.dialect)
    joints = {}

    @cache  # every joint asks for the same times
    def pose_at(t: float) -> tuple[float, ...] | None:
        return operator.intent(t - begin, side)

    for i, joint in enumerate(hand.joints):

        def wanted(t: float, i: int = i) -> float | None:
            pose = pose_at(t)
            return None if pose is None else pose[i]

        figures = tracking_figures(
            hand.states.t, hand.states.q[:, i], wanted, joint.stroke, begin=begin, end=end
        )
        if figures.steps or figures.figures():
            joints[i] = figures
    return _OperatorFigures(begin, end, (len(sent) - 1) / float(sent[-1] - sent[0]), joints)


def _judge(
    ctx: Context,
    name: str,
    limit: str,
    value: Callable[[TrackingFigures], float],
    of_step: Callable[[Step], float] | None,
    text: Callable[[float], str],
    nothing: str,
) -> Outcome:
    """The joint with the worst figure against a tolerance."""
    side = ctx.side
    assert isinstance(side, Side), "these requirements are about hands"
    found = ctx.once("operator figures", lambda: _operator_figures(ctx.recording, side))
    if isinstance(found, str):
        return ctx.skipped(found)
    figures = {i: value(f) for i, f in found.joints.items()}
    figures = {i: x for i, x in figures.items() if not math.isnan(x)}
    if not figures:
        return ctx.skipped(nothing)
    joint = max(figures, key=lambda i: figures[i] / ctx.tolerance(limit, i))
    worst = figures[joint]
    values = {name: worst, "client_hz": found.client_hz}
    if name == "stroke_s":
        values["stroke_mean_s"] = found.joints[joint].stroke_mean_s
    if len(ctx.joints) > 1:
        values |= {f"{name}_{ctx.joints[i].name}": x for i, x in figures.items()}
    values = {k: v for k, v in values.items() if math.isfinite(v)}
    observed = ctx.named(text(worst), joint)
    if worst <= ctx.tolerance(limit, joint):
        return ctx.passed(text(worst), observed, **values)
    dialect = ctx.recording.dialect
    sides = tuple(Side) if dialect.commands_both else (side,)
    wanted = 1.0 / client_for(dialect, sides).period
    if found.client_hz < _PART * wanted:
        skipped = ctx.skipped(
            f"the kit's own client managed {found.client_hz:.0f} of {wanted:.0f} commands a "
            f"second: '{text(worst)}' may be its machine's fault; run again"
        )
        return replace(skipped, retry=True)
    places = [ctx.at(ctx.states.topic, found.begin, found.end)]
    if of_step is not None:
        steps = [s for s in found.joints[joint].steps if not of_step(s) < worst]
        places = [ctx.at(ctx.states.topic, s.at, s.end) for s in steps] or places
    size, how = (worst - ctx.tolerance(limit, joint)), "total" if of_step else "mean"
    if limit.endswith("_stroke"):
        size *= STROKE_S / ctx.joints[joint].stroke
    return ctx.failed(text(worst), observed, *places, **values).about(joint).if_late(size, how=how)


@check("DEX1-OPER-01", "DEX1-OPER-06", "DEX3-OPER-01")
def stroke(ctx: Context) -> Outcome:
    """Time of a full stroke."""

    def text(seconds: float) -> str:
        if math.isinf(seconds):
            return "the hand hardly moves"
        return f"full stroke {seconds:.2f} s"

    return _judge(
        ctx,
        "stroke_s",
        "max_stroke_s",
        lambda f: f.stroke_s,
        lambda s: s.stroke_s,
        text,
        "no step was long enough: something is in the way",
    )


@check("DEX1-OPER-02", "DEX3-OPER-02")
def lag(ctx: Context) -> Outcome:
    """Lag of the joint behind a slowly moving operator, seconds."""

    def text(seconds: float) -> str:
        if math.isinf(seconds):
            return "does not follow a slow motion"
        return f"lags {seconds * 1e3:.0f} ms"

    return _judge(
        ctx,
        "lag_s",
        "max_lag_s",
        lambda f: f.lag_s,
        None,
        text,
        "no slow motion was long enough",
    )


@check("DEX1-OPER-03", "DEX3-OPER-03")
def overshoot(ctx: Context) -> Outcome:
    """Overshoot of the joint beyond the operator's target."""
    return _judge(
        ctx,
        "overshoot_rad",
        "max_overshoot_stroke",
        lambda f: f.overshoot,
        lambda s: s.overshoot,
        lambda x: f"overshoots by {x:.3f} {ctx.unit}",
        "no step was completed",
    )


@check("DEX1-OPER-04", "DEX3-OPER-04")
def stuck(ctx: Context) -> Outcome:
    """Distance of the joint from the operator's target at rest."""
    return _judge(
        ctx,
        "stuck_rad",
        "max_stuck_stroke",
        lambda f: f.stuck,
        lambda s: s.stuck,
        lambda x: f"rests {x:.3f} {ctx.unit} off",
        "the hand came to rest after no step",
    )


@check("DEX1-OPER-05", "DEX3-OPER-05")
def reaction(ctx: Context) -> Outcome:
    """Seconds until the joint begins to move."""
    return _judge(
        ctx,
        "reaction_s",
        "max_reaction_s",
        lambda f: f.reaction_s,
        lambda s: s.reaction_s,
        lambda x: f"reacts after {x * 1e3:.0f} ms",
        "it moved after no step",
    )
