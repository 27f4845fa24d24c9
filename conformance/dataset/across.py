"""Compare the episodes of a set with each other, and with what its metadata say."""

from __future__ import annotations

from collections.abc import Mapping

from dexkit.conformance.dataset.findings import Finding, Judgement
from dexkit.conformance.dataset.whole_set import WholeSet

__all__ = ["OF_SETS", "across"]

OF_SETS = {
    "duplicate": "Every episode once",
    "statistics": "Statistics of the metadata are those of the data",
}
"""Names and titles of what is found here."""


def across(
    judgements: Mapping[str, Judgement], whole: WholeSet | None = None
) -> dict[str, list[Finding]]:
    """Findings that no episode shows alone.

    :param judgements: of the episodes of one set, by name.
    :param whole: what its metadata say; None where it has none.
    :returns: by the name of the episode, or of the set, what was found.
    """
    found: dict[str, list[Finding]] = {}
    return found
