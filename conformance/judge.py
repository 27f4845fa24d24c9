"""Judge a recording: every selected requirement, each side, in the catalogue's order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone

import numpy as np

from dexkit.conformance.checks import Check, Context, Outcome, all_checks
from dexkit.conformance.requirements import Level, Requirement, catalogue
from dexkit.conformance.results import TOO_BUSY, Result, RunResult, Verdict
from dexkit.conformance.usb.judge import judge_usb
from dexkit.conformance.view import Recording, SideView
from dexkit.hand import Side

__all__ = ["judge"]

STARVED = 0.5
"""Part of a failure's time that must be starved for it not to be blamed on the hand."""
_OPEN = (Verdict.FAIL, Verdict.BLOCKED, Verdict.ERROR)


def judge(
    recording: Recording,
    *,
    requirements: Sequence[Requirement] | None = None,
    subject: Mapping[str, str] | None = None,
) -> RunResult:
    """Judge ``recording``.

    :param requirements: those to report; what they depend on is judged as well. None for all.
    :param subject: what to say of what was judged.
    """
    every = catalogue(recording.model.name)
    wanted = {r.id for r in (every if requirements is None else requirements)}
    checks = all_checks()
    results: list[Result] = []
    for side in recording.judged:
        found: dict[str, Result] = {}
        for requirement in every:
            found[requirement.id] = _judge_one(
                recording, recording.sides[side], requirement, found, checks
            )
        results += [r for r in found.values() if r.requirement.id in wanted]
    order = {r.id: i for i, r in enumerate(every)}
    results.sort(key=lambda r: order[r.requirement.id])
    if recording.usb is not None:
        usb = catalogue(recording.model.name, "usb")
        judged = {str(side) for side in recording.judged}
        results += [
            r
            for r in judge_usb(recording.usb, usb)
            if r.side in judged and (requirements is None or r.requirement.id in wanted)
        ]
    about = {
        "model": recording.model.name,
        "dialect": recording.dialect.name,
        "sides": ", ".join(str(s) for s in recording.judged),
    }
    when = datetime.fromtimestamp(recording.origin_ns / 1e9, tz=timezone.utc)
    return RunResult(
        subject={**about, **(subject or {})},
        results=results,
        stage={str(s): _stage(recording, s) for s in recording.judged},
        duration_s=recording.duration,
        notes=list(recording.notes),
        starved=recording.starved(0.0, recording.duration),
        recorded_at=when.isoformat(timespec="seconds"),
    )


def _judge_one(
    recording: Recording,
    hand: SideView,
    requirement: Requirement,
    found: Mapping[str, Result],
    checks: Mapping[str, Check],
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

    def unjudged(reason: str) -> Result:
        return result(Verdict.NOT_APPLICABLE, Outcome(None, reason=reason))

    context = Context(recording, hand, requirement)
    dialect = recording.dialect.name
    if dialect not in requirement.dialects:
        return unjudged(f"does not apply to the dialect {dialect}")
    missing = _missing(context)
    if missing:
        return unjudged(missing)
    for before in requirement.after:
        if found[before].verdict in _OPEN:
            return result(Verdict.BLOCKED, Outcome(None, reason=f"blocked by {before}"))
    check = checks.get(requirement.id)
    if check is None:
        return result(Verdict.ERROR, Outcome(None, reason="no check judges this requirement"))
    try:
        outcome = check(context)
    except Exception as error:  # a check that breaks must not look like a hand that does
        text = f"the check itself failed: {type(error).__name__}: {error}"
        return result(Verdict.ERROR, Outcome(None, reason=text))
    if outcome.met is None:
        return result(Verdict.NOT_APPLICABLE, outcome)
    if outcome.met:
        return result(Verdict.PASS, outcome)
    excuse = _excuse(recording, requirement, outcome)
    if excuse:
        return result(Verdict.BLOCKED, replace(outcome, reason=excuse))
    return result(Verdict.FAIL if requirement.level is Level.MUST else Verdict.WARN, outcome)


def _excuse(recording: Recording, requirement: Requirement, outcome: Outcome) -> str:
    """Why a failure is not blamed on the hand: every place of it, or the run, was starved."""
    if not requirement.realtime:
        return ""
    spans = [(e.time_s, e.end_s) for e in outcome.evidence if e.end_s is not None]
    shares = [recording.starved(a, b) for a, b in spans] or [
        recording.starved(0.0, recording.duration)
    ]
    if min(shares) < STARVED:
        return ""
    return f"{TOO_BUSY} to tell: it lacked processor time for {min(shares):.0%} of it; run again"


def _missing(context: Context) -> str:
    """What the recording lacks for this requirement, or nothing."""
    requirement, recording = context.requirement, context.recording
    if requirement.phase:
        if recording.stimulus is None:
            return f"needs the stimulus '{requirement.phase}', which only a live run applies"
        if not recording.phases(requirement.phase):
            return f"the stimulus '{requirement.phase}' was not applied in this run"
        other = requirement.needs.startswith("other-")
        if not other and not context.phases():
            return f"the stimulus '{requirement.phase}' was not applied to the {context.side} hand"
    if requirement.needs == "endpoints" and not recording.endpoints:
        return "the recording does not say who published and subscribed (record dds_endpoints)"
    if requirement.needs in ("commands", "session") and not len(context.commands):
        return "no commands to this hand in the recording"
    return ""


def _stage(recording: Recording, side: Side) -> str:
    """How far a hand got: the first question when it fails."""
    hand = recording.sides[side]
    topic = hand.states.topic
    if len(hand.states):
        for q, joint in zip(hand.states.q.T, hand.joints, strict=True):
            good = q[np.isfinite(q)]
            if len(good) and float(np.ptp(good)) > 0.05 * joint.stroke:
                return "moving"
        return "samples flowing"
    if any(c.topic == topic for c in recording.channels) or any(
        e.topic == topic and e.kind == "writer" for e in recording.endpoints
    ):
        return "topic seen, no sample of the right type"
    return "nothing seen"
