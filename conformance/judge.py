"""Judge a recording: every selected requirement, each side, in the catalogue's order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check_of
from dexkit.conformance.claims import Claims
from dexkit.conformance.requirements import Requirement, catalogue
from dexkit.conformance.results import Result, RunResult, Stage
from dexkit.conformance.robot import RobotRecording
from dexkit.conformance.verdicts import Judgement, excuse
from dexkit.conformance.view import Recording, SideView
from dexkit.hand import Side

__all__ = ["judge"]

_SILENT = 0.5
"""Seconds without state, before the end of what a failure is about, that are no mere gap."""


def judge(
    recording: Recording,
    *,
    requirements: Sequence[Requirement] | None = None,
    claims: Claims | None = None,
    subject: Mapping[str, str] | None = None,
) -> RunResult:
    """Judge ``recording``.

    :param requirements: those to report; what they depend on is judged as well. None for all.
    :param claims: what the vendor claims of the hand.
    :param subject: what to say of what was judged.
    """
    claims = claims or Claims()
    every = claims.apply(catalogue(recording.model.name, recording.layer))
    wanted = None if requirements is None else {r.id for r in requirements}
    results: list[Result] = []
    for side in recording.judged:
        found: dict[str, Result] = {}
        for requirement in every:
            judgement = Judgement(requirement, side, claims, found)
            found[requirement.id] = _judge_one(recording, judgement, recording.sides[side])
        results += found.values()
    order = {r.id: i for i, r in enumerate(every)}
    results.sort(key=lambda r: order[r.requirement.id])
    if recording.usb is not None:
        from dexkit.conformance.usb.judge import judge_usb

        usb = claims.apply(catalogue(recording.model.name, "usb"))
        judged = {str(side) for side in recording.judged}
        results += [r for r in judge_usb(recording.usb, usb, claims) if r.side in judged]
    about = {
        "model": recording.model.name,
        "dialect": recording.dialect.name,
        "sides": ", ".join(str(s) for s in recording.judged),
    }
    when = datetime.fromtimestamp(recording.origin_ns / 1e9, tz=timezone.utc)
    return RunResult(
        subject={**claims.subject, **about, **(subject or {})},
        results=[r for r in results if wanted is None or r.requirement.id in wanted],
        stage={str(s): _stage(recording, s) for s in recording.judged},
        duration_s=recording.duration,
        notes=list(recording.notes),
        harness=_harness(recording),
        claims=None if claims.units is None else dict(claims.units),
        catalogue=len({r.requirement.id for r in results}),
        recorded_at=when.isoformat(timespec="seconds"),
    )


def _judge_one(recording: Recording, judgement: Judgement, hand: SideView) -> Result:
    requirement = judgement.requirement
    dialect = recording.dialect.name
    if dialect not in requirement.dialects:
        return judgement.not_applicable(f"does not apply to the dialect {dialect}")
    unclaimed = judgement.not_claimed()
    if unclaimed:
        return unclaimed
    if isinstance(recording, RobotRecording):
        from dexkit.conformance.checks.robot import RobotContext

        context: Context = RobotContext(recording, hand, requirement)
    else:
        context = Context(recording, hand, requirement)
    missing = _missing(context)
    if missing:
        return judgement.not_applicable(missing)
    return judgement.blocked() or judgement.of(
        lambda: _in_silence(context, check_of(requirement)(context)),
        lambda outcome: excuse(recording, requirement, outcome, (0.0, recording.duration)),
    )


def _in_silence(context: Context, outcome: Outcome) -> Outcome:
    """The outcome; a failure where the hand had fallen silent for good has that as its cause."""
    states, commands = context.states, context.commands
    ends = [e.end_s for e in outcome.evidence if e.end_s is not None]
    if not ends and len(commands):  # no state, so no place either
        ends = [float(commands.t[-1])]
    if outcome.met is not False or not len(states) or not ends:
        return outcome
    last = float(states.t[-1])
    if max(ends) < last + _SILENT:
        return outcome
    return replace(
        outcome,
        cause=f"The hand fell silent for good at {last:.1f} s: has its service ended, or does it "
        "hang? Its own log may say why.",
    )


_NOT_OURS = (
    "the kit ends and starts only a service that it has started itself (not --backend external)"
)
_REMEDY = {
    "squeeze": "put something between the fingers, and say where it is felt (--object {side}=PCT)",
    "shutdown": _NOT_OURS,
    "service-restart": _NOT_OURS,
}
"""What to do, or why not, where a stimulus was not applied."""


def _missing(context: Context) -> str:
    """What the recording lacks for this requirement, or nothing."""
    requirement, recording = context.requirement, context.recording
    if requirement.phase:
        if recording.stimulus is None:
            return f"needs the stimulus '{requirement.phase}', which only a live run applies"
        why = _REMEDY.get(requirement.phase, "")
        why = f": {why.format(side=context.side)}" if why else ""
        if not recording.phases(requirement.phase):
            return f"the stimulus '{requirement.phase}' was not applied in this run{why}"
        if not requirement.moves_other_side and not context.phases():
            to = f"the {context.side} hand"
            return f"the stimulus '{requirement.phase}' was not applied to {to}{why}"
    if requirement.needs_discovery and not recording.endpoints:
        return "the recording does not say who published and subscribed (record dds_endpoints)"
    if requirement.needs_commands and not len(context.commands):
        return "no commands to this hand in the recording"
    return ""


def _harness(recording: Recording) -> dict[str, float]:
    """How fair the kit's own machine was; empty where somebody else recorded."""
    if recording.stimulus is None:
        return {}
    figures = {"starved": recording.starved(0.0, recording.duration)}
    late = recording.lateness(0.0, recording.duration)
    if late is not None:
        figures |= {"jitter_p50_ms": late[0] * 1e3, "jitter_p99_ms": late[1] * 1e3}
    return figures


def _stage(recording: Recording, side: Side) -> Stage:
    """How far a hand got."""
    hand = recording.sides[side]
    for q, joint in zip(hand.states.q.T, hand.joints, strict=True):
        good = q[np.isfinite(q)]
        if len(good) and float(np.ptp(good)) > 0.05 * joint.stroke:
            return Stage.MOVING
    if len(hand.states):
        return Stage.SAMPLES_FLOWING
    # a client's own endpoints, the kit's among them, are no sign of a hand
    dialect = recording.dialect
    clients = {(dialect.topics(s)[0], "writer") for s in Side}
    clients |= {(dialect.topics(s)[1], "reader") for s in Side}
    present = [(e.topic, e.kind, e.type_name) for e in recording.endpoints]
    present += [(c.topic, "writer", c.type_name) for c in recording.channels]
    seen = {(topic, kind) for topic, role, kind in present if (topic, role) not in clients}
    topic = hand.states.topic
    if (topic, dialect.state_type) in seen:
        return Stage.TYPE_MATCHED
    if topic in {name for name, _ in seen}:
        return Stage.TOPIC_SEEN
    return Stage.PARTICIPANT_SEEN if seen else Stage.NO_PARTICIPANT
