"""Judge a recording: from decoded DDS or USB data to one verdict for each requirement.

Every selected requirement is judged for each subject, in the catalogue's order. What differs from
layer to layer is data, in :mod:`dexkit.conformance.layers`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import datetime, timezone
from functools import cache
from typing import Any

import numpy as np

from dexkit.conformance.checks import Outcome, check_of
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.measurement_error import Measure, weigh
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.kit.results import Result, RunResult, Stage
from dexkit.conformance.kit.run_record import recorded_subject
from dexkit.conformance.kit.stimulus_record import CALIBRATION_TOPIC
from dexkit.conformance.kit.stories import stories_of
from dexkit.conformance.kit.verdicts import Judgement, excuse
from dexkit.conformance.layers import ContextT, Layer, RecordingT, ViewT, layer
from dexkit.hand import Side, Subject

__all__ = ["deciding", "judge", "judge_layer", "results_of"]

_ANY_TIME = 0.0, 1e6
"""Begin and end, seconds, of a recording whose layer does not say how long it is."""


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
    :param subject: entries for the result's ``subject`` beside those of the run record: the
        recording.
    """
    claims = claims or Claims()
    wanted = None if requirements is None else {r.id for r in requirements}
    client, results = results_of(recording, claims)
    chosen = [r for r in results if wanted is None or r.requirement.id in wanted]
    if wanted is not None:  # what blocks another requirement is reported with it
        wanted |= {r.blocked_by for r in chosen}
    about = {
        "model": recording.model.name,
        "dialect": recording.dialect.name,
        "sides": ", ".join(str(s) for s in recording.judged),
    }
    when = datetime.fromtimestamp(recording.origin_ns / 1e9, tz=timezone.utc)
    stories = stories_of(recording, chosen, lambda part, names: results_of(part, claims, names)[1])
    return RunResult(
        stories=stories,
        subject={
            **claims.subject,
            **about,
            **recorded_subject(recording.run),
            **(subject or {}),
        },
        results=chosen,
        client=[r for r in client if wanted is None or r.requirement.id in wanted],
        stage={str(s): _stage(recording, s) for s in recording.judged},
        duration_s=recording.duration,
        notes=list(recording.notes),
        harness=_harness(recording),
        claims=None if claims.units is None else dict(claims.units),
        catalogue=len({r.requirement.id for r in results}),
        recorded_at=when.isoformat(timespec="seconds"),
        run=dict(recording.run),
    )


def results_of(
    recording: Recording, claims: Claims | None = None, only: Collection[str] | None = None
) -> tuple[list[Result], list[Result]]:
    """The results of the requirements about the client, and of all others.

    :param only: ids of those to judge; what decides about them is judged as well. None for all.
    """
    claims = claims or Claims()
    model = recording.model.name
    chosen = None if only is None else {r.id for name in only for r in deciding(model, name)}

    def judged(name: str, part: Any, client: Sequence[Result] = ()) -> list[Result]:
        every = claims.apply(catalogue(model, name))
        some = [r for r in every if chosen is None or r.id in chosen]
        return judge_layer(layer(name), part, some, claims, client)

    # in a run of the kit the kit is the client, and sends wrong commands on purpose
    client = judged("client", recording) if recording.stimulus is None else []
    results = judged(recording.layer, recording, client)
    if recording.usb is not None:
        sides = {str(side) for side in recording.judged}
        results += [r for r in judged("usb", recording.usb) if r.side in sides]
    return client, results


@cache
def deciding(model: str, name: str) -> tuple[Requirement, ...]:
    """A requirement, and all those whose verdicts decide whether it is judged at all."""
    every = {r.id: r for r in catalogue(model, None)}
    found: dict[str, Requirement] = {}
    todo = [name]
    while todo:
        one = todo.pop()
        if one in found:
            continue
        found[one] = every[one]
        todo += every[one].after
        todo += [r.id for r in every.values() if r.spoils and one.startswith(r.spoils)]
    return tuple(found.values())


def judge_layer(
    layer: Layer[RecordingT, ViewT, ContextT],
    recording: RecordingT,
    requirements: Sequence[Requirement],
    claims: Claims | None = None,
    client: Sequence[Result] = (),
) -> list[Result]:
    """Judge every requirement of one layer for every subject; results in the requirements' order.

    :param requirements: those of the layer that are about the model, at the levels that ``claims``
        gives them, with those that :func:`deciding` names: some are judged by what came before.
    :param claims: what the vendor claims of the hand.
    :param client: results of the requirements about the client, of every subject.
    """
    claims = claims or Claims()
    make_context, whole = layer.context.load(), layer.whole(recording)
    results: list[Result] = []
    for subject, view in layer.subjects(recording):
        found: dict[str, Result] = {}
        driven_by = [r for r in client if r.side == str(subject)]
        for requirement in requirements:
            judgement = Judgement(requirement, subject, claims, found, driven_by)
            context = make_context(recording, view, requirement)
            found[requirement.id] = _judge_one(layer, judgement, context, whole)
        results += found.values()
    order = {r.id: i for i, r in enumerate(requirements)}
    return sorted(results, key=lambda r: order[r.requirement.id])


def _judge_one(
    layer: Layer[Any, Any, Any],
    judgement: Judgement,
    context: Any,
    whole: tuple[float, float] | None,
) -> Result:
    for precondition in layer.preconditions:
        decided: Result | None = precondition(judgement, context)
        if decided:
            return decided
    requirement = judgement.requirement
    return judgement.run_check(
        lambda: context.in_unit(layer.refine(context, check_of(requirement)(context))),
        lambda outcome: excuse(context.recording, requirement, outcome, judgement.subject, whole),
        lambda outcome: _weighed(context.recording, outcome, whole),
    )


def _weighed(recording: Any, outcome: Outcome, whole: tuple[float, float] | None) -> Measure | None:
    places = [(e.time_s, e.end_s) for e in outcome.evidence]
    return weigh(recording, outcome.measures, places, whole or _ANY_TIME)


def _harness(recording: Recording) -> dict[str, float]:
    """Load and timer jitter of the machine that the kit ran on, and how long the hands' processes
    waited there; empty without a stimulus record.
    """
    if recording.stimulus is None:
        return {}
    figures = {"starved": recording.starved(0.0, recording.duration)}
    late = recording.lateness(0.0, recording.duration)
    if late is not None:
        figures |= {"jitter_p50_ms": late[0] * 1e3, "jitter_p99_ms": late[1] * 1e3}
    waited = [recording.starvation(s, 0.0, recording.duration) for s in recording.judged]
    if known := [w for w in waited if w is not None]:
        figures["waited"] = max(w.worst.part for w in known)
        figures["longest_wait_ms"] = max(w.longest for w in known) * 1e3
    return figures


def _stage(recording: Recording, side: Subject) -> Stage:
    """The stage that a hand or robot reached, from discovery to motion."""
    hand = recording.sides[side]
    for q, joint in zip(hand.states.q.T, hand.joints, strict=True):
        good = q[np.isfinite(q)]
        if len(good) and float(np.ptp(good)) > 0.05 * joint.stroke:
            return Stage.MOVING
    if len(hand.states):
        return Stage.SAMPLES_FLOWING
    # endpoints of clients, the kit's included, do not show that a hand is present
    dialect = recording.dialect
    clients = {(dialect.topics(s)[0], "writer") for s in Side}
    clients |= {(dialect.topics(s)[1], "reader") for s in Side}
    clients.add((CALIBRATION_TOPIC, "writer"))
    present = [(e.topic, e.kind, e.type_name) for e in recording.endpoints]
    present += [(c.topic, "writer", c.type_name) for c in recording.channels]
    seen = {(topic, kind) for topic, role, kind in present if (topic, role) not in clients}
    topic = hand.states.topic
    if (topic, dialect.state_type) in seen:
        return Stage.TYPE_MATCHED
    if topic in {name for name, _ in seen}:
        return Stage.TOPIC_SEEN
    return Stage.PARTICIPANT_SEEN if seen else Stage.NO_PARTICIPANT
