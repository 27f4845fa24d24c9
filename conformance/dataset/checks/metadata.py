"""What the metadata say of an episode: its task."""

from __future__ import annotations

from collections.abc import Iterator

from dexkit.conformance.dataset.check import Check, Data
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use

__all__ = ["CHECKS"]


def _task(episode: Episode) -> Iterator[Finding]:
    if not episode.tasks:
        yield Finding("task", Use.REVIEW, "it has no task text, which policies with language need")


CHECKS = (Check("task", "A task text", frozenset({Data.TASK}), _task),)
