"""Judge the recording of a result again, and compare the verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dexkit.conformance.claims import Claims
from dexkit.conformance.judge import judge
from dexkit.conformance.layers import recording_of
from dexkit.conformance.requirements import CAPABILITIES, Kind
from dexkit.conformance.results import VERSION, Result, RunResult
from dexkit.traces import open_trace

__all__ = ["claimed_differences", "judged_again", "verdict_differences"]

_ABOUT = ("model", "dialect", "sides")


def judged_again(found: RunResult, recording: Path) -> tuple[RunResult, list[str]]:
    """Judge a recording as a result was: same dialect, sides, claims and requirements.

    Returns the new result, and remarks on damage of the recording.

    :raises DexkitError: the recording cannot be read, or is not of that kind of hand.
    """
    trace = open_trace(recording)
    view = recording_of(trace, found.subject.get("dialect"), found.hands)
    claims = Claims()
    if found.claims is not None:
        claims = Claims({unit: found.claims.get(unit, False) for unit in CAPABILITIES})
    wanted = [r.requirement for r in (*found.results, *found.client)]
    again = judge(view, requirements=wanted, claims=claims)
    return again, list(trace.damage)


def verdict_differences(found: RunResult, again: RunResult) -> list[str]:
    """One line for each difference between a result and what its recording was judged now.

    Compared are: what was judged, when it was recorded, each verdict with the level of its
    requirement, and both grades. Figures and texts are not.
    """
    lines = [
        f"{name}: {found.subject.get(name, '')} in the result, {again.subject[name]} when judged "
        "again"
        for name in _ABOUT
        if found.subject.get(name, "") != again.subject[name]
    ]
    if found.recorded_at != again.recorded_at:
        lines.append(
            f"recorded at: {found.recorded_at} in the result, {again.recorded_at} when judged again"
        )
    before, now = _verdicts(found), _verdicts(again)
    for id_, side in dict.fromkeys([*before, *now]):
        was, is_ = before.get((id_, side), "not judged"), now.get((id_, side), "not judged")
        if was != is_:
            lines.append(f"{id_} {side}: {was} in the result, {is_} when judged again")
    for kind in Kind:
        was, is_ = str(found.grade(kind).overall), str(again.grade(kind).overall)
        if was != is_:
            lines.append(f"{kind}: {was} in the result, {is_} when judged again")
    if lines and found.environment.get("dexkit") != again.environment["dexkit"]:
        lines.append(
            f"dexkit: {found.environment.get('dexkit') or 'an unknown version'} made the result, "
            f"{again.environment['dexkit']} judged again, which may be the reason"
        )
    return lines


def _verdicts(result: RunResult) -> dict[tuple[str, str], str]:
    every: list[Result] = [*result.results, *result.client]
    return {(r.requirement.id, r.side): f"{r.requirement.level} {r.verdict}" for r in every}


def claimed_differences(document: Mapping[str, Any], found: RunResult) -> list[str]:
    """One line for each summary in a result file that is not that of its own verdicts.

    :param document: the file, which has ``overall``, ``counts`` and ``grades`` beside the results.
    """
    if document.get("version") != VERSION:
        return []
    real = found.as_dict()
    pairs = [("overall", document.get("overall"), real["overall"])]
    pairs.append(("counts", document.get("counts"), real["counts"]))
    for kind, grade in document.get("grades", {}).items():
        for name in ("overall", "counts"):
            pairs.append((f"grade {kind}, {name}", grade[name], real["grades"][kind][name]))
    return [
        f"{name}: the result does not say what follows from its own verdicts"
        for name, said, follows in pairs
        if said != follows
    ]
