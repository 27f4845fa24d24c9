"""What the checks of robots have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexkit.conformance.checks import Context, Outcome
from dexkit.conformance.checks.figures import Figure, Figures
from dexkit.conformance.kit.robot import RobotRecording
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.messages import Columns

LATE_S = 1.0  # s by which a state may be late on a busy machine


@dataclass(frozen=True)
class RobotContext(Context):
    """One requirement to be judged for the robot of a recording."""

    recording: RobotRecording

    @property
    def low(self) -> Columns:
        """All members of the states."""
        found = self.recording.low
        assert found is not None, "states are there: H1-TOPIC-01 has not failed"
        return found


def _at(ctx: RobotContext, row: int) -> float:
    return float(ctx.states.t[row])


def wrong_rows(
    ctx: RobotContext, bad: ArrayLike, figure: str, what: str, joints: tuple[int, ...] = ()
) -> Outcome:
    """A failure in the samples where ``bad`` is true, about these joints."""
    rows = np.flatnonzero(bad)
    places = [ctx.at(ctx.states.topic, _at(ctx, int(i))) for i in rows[:5]]
    text = f"{what}, in {len(rows)} of {len(ctx.states)} states"
    return ctx.failed(figure, text, *places, wrong=len(rows)).about(*joints)


def joint_of(ctx: RobotContext, phase: Phase) -> int:
    """The joint that a phase moves."""
    return ctx.recording.robot.used.index(int(phase.params["slot"]))


def no_state(ctx: RobotContext, phase: Phase) -> Outcome:
    """The outcome without a state in the phase: failed, or not judged if states come later."""
    begin, end = ctx.span(phase)
    if len(ctx.q(end, end + LATE_S)):
        return ctx.skipped(f"no state in '{phase.name}', only later")
    place = ctx.at(ctx.states.topic, begin, end)
    return ctx.failed("no state", f"no state during '{phase.name}', nor after it", place)


def only_phase(ctx: RobotContext) -> tuple[Phase, float, float, int]:
    """The only phase of a requirement, its begin and end, and its joint."""
    (phase,) = ctx.phases()
    return phase, *ctx.span(phase), joint_of(ctx, phase)


def between(
    value: float, low: float, high: float, begin: float, end: float, **more: Any
) -> Figures:
    """A figure with a least and a greatest value."""
    yield Figure(value, begin, end, limit=low, at_least=True, **more)
    yield Figure(value, begin, end, limit=high, at_least=False, **more)


def speed_between(ctx: RobotContext, phase: Phase, begin: float, end: float) -> float | None:
    """The mean speed of the phase's joint in [begin, end], rad/s."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.clock[rows], ctx.states.q[rows, joint_of(ctx, phase)]
    return float((q[-1] - q[0]) / (t[-1] - t[0])) if len(t) > 1 and t[-1] > t[0] else None
