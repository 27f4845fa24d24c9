"""dq of a command is the speed to go with, for position servos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dexkit.conformance.checks import Context, check
from dexkit.conformance.checks.figures import Figure, Figures, worst
from dexkit.conformance.checks.steps import Step, speed_of, steps_of
from dexkit.conformance.stimuli.fingers import CLOSED, OPEN, FingerScript
from dexkit.conformance.stimuli.phases import stimulus
from dexkit.conformance.stimuli.script import Steps
from dexkit.hand import Side

_SPEEDS = ((0.0, 0.1, 0.2, 0.3, 0.4, 0.15), (0.2, 0.4, -0.2, 0.15, 0.1, 0.3))
"""Speeds of the joints of position servos in two turns, parts of the full one."""
_SPEEDS_SECONDS = 0.5
"""Seconds of each turn with them."""


@stimulus("speeds", FingerScript, after="single")
def move_at_own_speeds(script: FingerScript) -> Steps:
    """Each joint closes with another speed, and one with none."""
    script.report("a speed for each joint: each must move with its own, and with 0 not at all")
    sides = script.plan.sides
    for speeds in _SPEEDS:
        yield from script.to("center", OPEN)
        poses = {s: script.pose(s, CLOSED) for s in sides}
        hands = {
            s: [
                replace(m, dq=speeds[(i + 3 * (s is Side.RIGHT)) % len(speeds)])
                for i, m in enumerate(script.motors(s, pose))
            ]
            for s, pose in poses.items()
        }
        yield from script.hold_as("speeds", sides, _SPEEDS_SECONDS, hands, targets=poses)
    yield from script.back()


_TURNS_S = 0.08  # s after which a joint has taken up a new speed


_LARGE = 0.3  # of the travel: a step that shows a joint's full speed


_MOST_OF_IT = 0.9  # part of a way after which a joint may slow down


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


def _full_speed(ctx: Context, joint: int) -> float:
    """A joint's own full speed: that of its fastest large step, or else the model's."""
    speeds = [
        speed
        for phase in (*ctx.phases("joint"), *ctx.phases("ends"))
        for step in steps_of(ctx, phase)
        if step.joint == joint and abs(step.size) >= _LARGE * step.stroke
        if (speed := speed_of(step)) is not None
    ]
    return max(speeds, default=ctx.joints[joint].dq_max)


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
        part = float(way[last]) / seconds / _full_speed(ctx, step.joint)
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
