"""The layer ``usb``: Dex3-1 hands, judged by their USB transfers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dexkit.conformance.behaviours import CHECKS
from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.layers import Layer
from dexkit.conformance.layers.preconditions import claimed, not_blocked
from dexkit.hand import Subject
from dexkit.lazy import Lazy

if TYPE_CHECKING:
    from dexkit.conformance.kit.recording import TraceLike
    from dexkit.conformance.kit.results import Result
    from dexkit.conformance.kit.verdicts import Judgement
    from dexkit.conformance.usb.context import UsbContext
    from dexkit.conformance.usb.recording import UsbRecording, UsbSide

__all__ = ["LAYER"]

_SCRIPT: Lazy[type[Any]] = Lazy("dexkit.conformance.stimuli.usb:UsbScript")
_REFERENCE: Lazy[type[Any]] = Lazy("dexkit.conformance.virtual.usb:ReferenceDevice")


def _decode(trace: TraceLike, name: str | None, sides: Sequence[Subject]) -> UsbRecording | None:
    from dexkit.conformance.usb import RECORD

    if RECORD not in trace.metadata:  # the others are read without this part of the kit
        return None
    from dexkit.conformance.usb.recording import UsbRecording

    return UsbRecording.decode(trace)


def _stimulus_applied(judgement: Judgement, context: UsbContext) -> Result | None:
    """A precondition: the phase that is needed is in the recording."""
    phase = judgement.requirement.phase
    if not phase or context.hand.phases(phase):
        return None
    reason = f"the stimulus '{phase}' was not applied"
    trouble = context.hand.record.trouble
    return judgement.not_applicable(f"{reason}: {trouble}" if trouble else reason)


LAYER: Layer[UsbRecording, UsbSide, UsbContext] = Layer(
    name="usb",
    checks=CHECKS,
    plots=(Plot(PlotKind.ANSWERS), Plot(PlotKind.BYTES)),
    decode=_decode,
    subjects=lambda recording: recording.sides.items(),
    context=Lazy("dexkit.conformance.usb.context:UsbContext"),
    # not_blocked comes first: the script ends where a device no longer answers, and the first
    # failure is the reason of missing phases
    preconditions=(claimed, not_blocked, _stimulus_applied),
    refine=lambda context, outcome: outcome,
    whole=lambda recording: None,
    script=lambda name: _SCRIPT.load(),
    reference=lambda name: _REFERENCE.load(),
)
