"""The layer ``robot``: a robot, judged by what a recording holds of its low-level DDS topics."""

from __future__ import annotations

from collections.abc import Sequence

from dexkit.conformance.checks.robot import RobotContext
from dexkit.conformance.layers import Layer, claimed, hand, not_blocked
from dexkit.conformance.recording import SideView, TraceLike
from dexkit.conformance.robot import RobotRecording, robot_in, robot_recording
from dexkit.errors import UsageError
from dexkit.hand import ROBOT, Subject
from dexkit.robots import H1

__all__ = ["LAYER"]


def _decode(trace: TraceLike, name: str | None, sides: Sequence[Subject]) -> RobotRecording:
    if sides not in ((), (ROBOT,)):
        raise UsageError("a robot has no sides", hint="leave --side out")
    found = name or (robot_in(trace) or H1).name
    return robot_recording(trace, found)


def _script(model: str) -> type:
    from dexkit.conformance.stimuli.robot import RobotScript

    return RobotScript


def _reference(model: str) -> type:
    from dexkit.conformance.virtual.robot import ReferenceRobot

    return ReferenceRobot


LAYER: Layer[RobotRecording, SideView, RobotContext] = Layer(
    name="robot",
    decode=_decode,
    subjects=hand.subjects,
    context=RobotContext,
    preconditions=(hand.applies_to_dialect, claimed, hand.recorded, not_blocked),
    refine=hand.with_silence,
    whole=hand.whole,
    script=_script,
    reference=_reference,
)
