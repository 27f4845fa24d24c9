"""The layer ``usb``: Dex3-1 hands, judged by their USB transfers."""

from __future__ import annotations

from dexkit.conformance.layers import Layer, claimed, not_blocked
from dexkit.conformance.results import Result
from dexkit.conformance.usb.checks import UsbContext
from dexkit.conformance.usb.recording import UsbRecording, UsbSide
from dexkit.conformance.verdicts import Judgement

__all__ = ["LAYER"]


def _stimulus_applied(judgement: Judgement, context: UsbContext) -> Result | None:
    """A precondition: the phase that is needed is in the recording."""
    phase = judgement.requirement.phase
    if not phase or context.hand.phases(phase):
        return None
    reason = f"the stimulus '{phase}' was not applied"
    trouble = context.hand.record.trouble
    return judgement.not_applicable(f"{reason}: {trouble}" if trouble else reason)


def _script(model: str) -> type:
    from dexkit.conformance.stimuli.usb import UsbScript

    return UsbScript


def _reference(model: str) -> type:
    from dexkit.conformance.virtual.usb import ReferenceDevice

    return ReferenceDevice


LAYER: Layer[UsbRecording, UsbSide, UsbContext] = Layer(
    name="usb",
    decode=lambda trace, dialect_name, sides: UsbRecording.decode(trace),
    subjects=lambda recording: recording.sides.items(),
    context=UsbContext,
    # not_blocked comes first: the script ends where a device no longer answers, and the first
    # failure is the reason of missing phases
    preconditions=(claimed, not_blocked, _stimulus_applied),
    refine=lambda context, outcome: outcome,
    whole=lambda recording: None,
    script=_script,
    reference=_reference,
)
