"""Judge the USB part of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dexkit.conformance.checks import Outcome
from dexkit.conformance.requirements import Level, Requirement
from dexkit.conformance.results import TOO_BUSY, Result, Verdict
from dexkit.conformance.usb.checks import CHECKS, UsbContext
from dexkit.conformance.usb.view import UsbRecording, UsbSide

__all__ = ["judge_usb"]

STARVED = 0.5
"""Part of a failure's time that must be starved for it not to be blamed on the hand."""
_OPEN = (Verdict.FAIL, Verdict.BLOCKED, Verdict.ERROR)


def judge_usb(recording: UsbRecording, requirements: Sequence[Requirement]) -> list[Result]:
    """What is found for every requirement and hand, in their order.

    :param requirements: all those of the USB layer: some are judged by what came before them.
    """
    results: list[Result] = []
    for hand in recording.sides.values():
        found: dict[str, Result] = {}
        for requirement in requirements:
            found[requirement.id] = _judge_one(recording, hand, requirement, found)
        results += found.values()
    order = {r.id: i for i, r in enumerate(requirements)}
    return sorted(results, key=lambda r: order[r.requirement.id])


def _judge_one(
    recording: UsbRecording,
    hand: UsbSide,
    requirement: Requirement,
    found: Mapping[str, Result],
) -> Result:
    def result(verdict: Verdict, outcome: Outcome) -> Result:
        return Result(
            requirement=requirement,
            side=str(hand.side),
            verdict=verdict,
            figure=outcome.figure,
            observed=outcome.observed,
            reason=outcome.reason,
            evidence=outcome.evidence,
            values=outcome.values,
        )

    # what failed first explains a missing phase better than its absence does
    for before in requirement.after:
        if found[before].verdict in _OPEN:
            return result(Verdict.BLOCKED, Outcome(None, reason=f"blocked by {before}"))
    if requirement.phase and not hand.phases(requirement.phase):
        reason = f"the stimulus '{requirement.phase}' was not applied"
        trouble = hand.record.trouble
        return result(
            Verdict.NOT_APPLICABLE,
            Outcome(None, reason=f"{reason}: {trouble}" if trouble else reason),
        )
    try:
        outcome = CHECKS[requirement.id](UsbContext(recording, hand, requirement))
    except Exception as error:  # a check that breaks must not look like a hand that does
        text = f"the check itself failed: {type(error).__name__}: {error}"
        return result(Verdict.ERROR, Outcome(None, reason=text))
    if outcome.met is None:
        return result(Verdict.NOT_APPLICABLE, outcome)
    if outcome.met:
        return result(Verdict.PASS, outcome)
    excuse = _excuse(recording, requirement, outcome)
    if excuse:
        # an open MUST has the run done again; nothing hangs on the others
        must = requirement.level is Level.MUST
        verdict = Verdict.BLOCKED if must else Verdict.NOT_APPLICABLE
        return result(verdict, replace(outcome, reason=excuse))
    return result(Verdict.FAIL if requirement.level is Level.MUST else Verdict.WARN, outcome)


def _excuse(recording: UsbRecording, requirement: Requirement, outcome: Outcome) -> str:
    """Why a failure is not blamed on the hand: the machine was starved at each place of it."""
    spans = [(e.time_s, e.end_s) for e in outcome.evidence if e.end_s is not None]
    if not requirement.realtime or not spans:
        return ""
    share = min(recording.starved(a, b) for a, b in spans)
    if share < STARVED:
        return ""
    return f"{TOO_BUSY} to tell: it lacked processor time for {share:.0%} of it; run again"
