"""The layer ``robot``: a robot, judged by what a recording holds of its low-level DDS topics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dexkit.conformance.behaviours import CHECKS
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.layers import Layer, hand
from dexkit.conformance.layers.preconditions import claimed, not_blocked
from dexkit.errors import UsageError
from dexkit.hand import ROBOT, Subject
from dexkit.lazy import Lazy
from dexkit.robots import H1

if TYPE_CHECKING:
    from dexkit.conformance.checks.robot import RobotContext
    from dexkit.conformance.kit.recording import SideView, TraceLike
    from dexkit.conformance.kit.robot import RobotRecording

__all__ = ["LAYER"]


def _decode(trace: TraceLike, name: str | None, sides: Sequence[Subject]) -> RobotRecording:
    from dexkit.conformance.kit.robot import robot_in, robot_recording

    if sides not in ((), (ROBOT,)):
        raise UsageError("a robot has no sides", hint="leave --side out")
    found = name or (robot_in(trace) or H1).name
    return robot_recording(trace, found)


LAYER: Layer[RobotRecording, SideView, RobotContext] = Layer(
    name="robot",
    checks=CHECKS,
    plots=(Plot(PlotKind.POSITION),),
    decode=_decode,
    subjects=hand.one_by_one,
    context=Lazy("dexkit.conformance.checks.robot:RobotContext"),
    preconditions=(hand.applies_to_dialect, claimed, hand.recorded, hand.carried, not_blocked),
    refine=hand.with_silence,
    whole=hand.whole,
    script=lambda name: under_test(name).script.load(),
    reference=lambda name: under_test(name).reference.load(),
)
