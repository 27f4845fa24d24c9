"""The layer ``robot``: a robot, judged by what a recording holds of its low-level DDS topics."""

from __future__ import annotations

from dexkit.conformance.checks.robot import RobotContext
from dexkit.conformance.layers import Layer, claimed, hand, not_blocked
from dexkit.conformance.recording import SideView
from dexkit.conformance.robot import RobotRecording

__all__ = ["LAYER"]


def _script(model: str) -> type:
    from dexkit.conformance.stimuli.robot import RobotScript

    return RobotScript


def _reference(model: str) -> type:
    from dexkit.conformance.virtual.robot import ReferenceRobot

    return ReferenceRobot


LAYER: Layer[RobotRecording, SideView, RobotContext] = Layer(
    name="robot",
    subjects=hand.subjects,
    context=RobotContext,
    preconditions=(hand.applies_to_dialect, claimed, hand.recorded, not_blocked),
    refine=hand.with_silence,
    whole=hand.whole,
    script=_script,
    reference=_reference,
)
