"""What is pinned of results: of each requirement, the verdict and figure of each side."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import results_of
from dexkit.conformance.kit.results import Result
from dexkit.traces import open_trace

__all__ = ["Verdicts", "judge_sample", "verdicts_of"]

Verdicts = Mapping[str, Mapping[str, tuple[str, str]]]
"""Verdict and figure, by requirement and side."""


def judge_sample(path: Path, only: Collection[str] | None = None) -> list[Result]:
    """Judge a sample, its client included."""
    client, results = results_of(recording_of(open_trace(path), None, ()), only=only)
    return [*client, *results]


def verdicts_of(results: Iterable[Result], judged: Iterable[str]) -> Verdicts:
    """The verdicts of results.

    :param judged: ids of the requirements; what has no result was about none of the sides.
    """
    found: dict[str, dict[str, tuple[str, str]]] = {name: {} for name in judged}
    for r in results:
        if r.requirement.id in found:
            found[r.requirement.id][r.side] = (str(r.verdict), r.figure)
    return found
