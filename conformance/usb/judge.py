"""Judge the USB part of a recording."""

from __future__ import annotations

from collections.abc import Sequence

from dexkit.conformance.checks import check_of
from dexkit.conformance.claims import Claims
from dexkit.conformance.requirements import Requirement
from dexkit.conformance.results import Result
from dexkit.conformance.usb.checks import UsbContext
from dexkit.conformance.usb.view import UsbRecording, UsbSide
from dexkit.conformance.verdicts import Judgement, excuse

__all__ = ["judge_usb"]


def judge_usb(
    recording: UsbRecording, requirements: Sequence[Requirement], claims: Claims | None = None
) -> list[Result]:
    """What is found for every requirement and hand, in their order.

    :param requirements: all those of the USB layer: some are judged by what came before them.
    :param claims: what the vendor claims of the hand; applied to ``requirements`` already.
    """
    results: list[Result] = []
    for hand in recording.sides.values():
        found: dict[str, Result] = {}
        for requirement in requirements:
            judgement = Judgement(requirement, hand.side, claims or Claims(), found)
            found[requirement.id] = _judge_one(recording, hand, judgement)
        results += found.values()
    order = {r.id: i for i, r in enumerate(requirements)}
    return sorted(results, key=lambda r: order[r.requirement.id])


def _judge_one(recording: UsbRecording, hand: UsbSide, judgement: Judgement) -> Result:
    requirement = judgement.requirement
    # what failed first explains a missing phase better than its absence does
    early = judgement.not_claimed() or judgement.blocked()
    if early:
        return early
    if requirement.phase and not hand.phases(requirement.phase):
        reason = f"the stimulus '{requirement.phase}' was not applied"
        trouble = hand.record.trouble
        return judgement.not_applicable(f"{reason}: {trouble}" if trouble else reason)
    return judgement.of(
        lambda: check_of(requirement)(UsbContext(recording, hand, requirement)),
        lambda outcome: excuse(recording, requirement, outcome),
    )
