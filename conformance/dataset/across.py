"""Compare the episodes of a set with each other, and with what its metadata say."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

import numpy as np

from dexkit.conformance.dataset.camera_sets import never_moving
from dexkit.conformance.dataset.findings import Finding, Judgement, Use
from dexkit.conformance.dataset.likeness import alike
from dexkit.conformance.dataset.whole_set import WholeSet

__all__ = ["OF_SETS", "across"]

OF_SETS = {
    "duplicate": "Copies of another episode",
    "statistics": "Statistics that are not those of the data",
}
"""Names and titles of what is found here."""

_COPY = re.compile(r"copy|dup|\(\d+\)|~", re.IGNORECASE)  # in names that people give to copies
_LAG = "lag of the "
_EPISODES = 8  # from which a usual lag can be told
_APART_S = 0.1  # three frames of 30 Hz
_SPREADS = 6.0  # standard deviations of a set's lags


def across(
    judgements: Mapping[str, Judgement], whole: WholeSet | None = None
) -> dict[str, list[Finding]]:
    """Findings that no episode shows alone.

    :param judgements: of the episodes of one set, by name.
    :param whole: what its metadata say; None where it has none.
    :returns: by the name of the episode, or of the set, what was found.
    """
    found: dict[str, list[Finding]] = {}
    kinds: dict[str, dict[str, Judgement]] = {}
    for name, judgement in judgements.items():
        kinds.setdefault(judgement.kind, {})[name] = judgement
    for kind in kinds.values():
        for name, finding in (*_duplicates(kind), *_late(kind), *never_moving(kind)):
            found.setdefault(name, []).append(finding)
    return found


def _duplicates(judgements: Mapping[str, Judgement]) -> Iterator[tuple[str, Finding]]:
    """Episodes that are there already. Of two, the one that is better, or comes first, stays."""
    order = list(Use)
    places = {name: i for i, name in enumerate(judgements)}

    def rank(name: str) -> tuple[int, bool, int]:
        return order.index(judgements[name].use), bool(_COPY.search(name)), places[name]

    told: set[str] = set()
    first: dict[str, str] = {}
    for name in sorted(judgements, key=rank):
        key = judgements[name].key
        if not key or not judgements[name].shape:
            continue
        if key in first:
            told.add(name)
            yield (
                name,
                Finding(
                    "duplicate",
                    Use.DROP,
                    f"it has the same numbers as {first[key]}, to the last digit",
                    value=0.0,
                ),
            )
        else:
            first[key] = name
    shapes = {name: j.shape for name, j in judgements.items() if name not in told}
    for a, b, difference in alike(shapes):
        stays, copy = sorted((a, b), key=rank)
        if copy in told:
            continue
        told.add(copy)
        yield (
            copy,
            Finding(
                "duplicate",
                Use.REVIEW,
                f"it has the same motion as {stays}: they differ by {difference:.1%}, two takes of "
                "one task by a third or more",
                value=round(difference, 4),
                limit=0.03,
            ),
        )


def _late(judgements: Mapping[str, Judgement]) -> Iterator[tuple[str, Finding]]:
    """Episodes in which a part is earlier or later behind its action than in all others."""
    figures = dict.fromkeys(f for j in judgements.values() for f in j.figures if f.startswith(_LAG))
    for figure in figures:
        lags = {n: j.figures[figure] for n, j in judgements.items() if figure in j.figures}
        if len(lags) < _EPISODES:
            continue
        values = np.array(list(lags.values()))
        usual = float(np.median(values))
        spread = 1.4826 * float(np.median(np.abs(values - usual)))
        limit = max(_APART_S, _SPREADS * spread)
        for name, lag in lags.items():
            if abs(lag - usual) <= limit or _is_told(judgements[name]):
                continue
            part = figure.removeprefix(_LAG).removesuffix(", s")
            yield (
                name,
                Finding(
                    "out-of-step",
                    Use.REVIEW,
                    f"the observation of the {part} is {lag:.2f} s behind its action, and "
                    f"{usual:.2f} s in the other episodes of the set",
                    part.replace(" ", "_"),
                    value=round(lag, 3),
                    limit=round(usual + limit if lag > usual else usual - limit, 3),
                    unit="s",
                ),
            )


def _is_told(judgement: Judgement) -> bool:
    return any(f.check == "out-of-step" for f in judgement.reasons)
