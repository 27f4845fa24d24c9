"""Compare the episodes of a set with each other, and with what its metadata say."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np

from dexkit.conformance.dataset.camera_sets import never_moving
from dexkit.conformance.dataset.findings import Finding, Judgement, Use
from dexkit.conformance.dataset.likeness import alike
from dexkit.conformance.dataset.set_values import (
    grasps_of_set,
    statistics_of_set,
    units_of_set,
)
from dexkit.conformance.dataset.whole_set import WholeSet

__all__ = ["OF_SETS", "across"]

OF_SETS = {
    "duplicate": "Copies of another episode",
    "statistics": "Statistics that are not those of the data",
}
"""Names and titles of what is found here."""

_COPY = re.compile(r"copy|dup|\(\d+\)|~", re.IGNORECASE)  # in names that people give to copies
_LAG = "lag of the "
_MOST = 0.75  # of the episodes of a set, whose cameras are those of the set
_EPISODES = 8  # from which a usual lag can be told
_APART_S = 0.1  # three frames of 30 Hz
_APART_ALONE_S = 0.35  # of one part alone, which may be slow
_TOGETHER_S = 0.05
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
        for name, finding in (
            *_duplicates(kind),
            *_late(kind),
            *_lacking(kind),
            *never_moving(kind),
            *grasps_of_set(kind),
            *units_of_set(kind),
        ):
            found.setdefault(name, []).append(finding)
    if whole is not None:
        for finding in statistics_of_set(judgements, whole):
            found.setdefault(whole.name, []).append(finding)
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


def _lacking(judgements: Mapping[str, Judgement]) -> Iterator[tuple[str, Finding]]:
    """Episodes without a camera that nearly all others have."""
    count = Counter(camera for j in judgements.values() for camera in j.cameras)
    for camera, n in count.items():
        if _MOST * len(judgements) <= n < len(judgements) and n >= _EPISODES // 2:
            text = f"it has no pictures of {camera}, which {n} of {len(judgements)} episodes have"
            for name, judgement in judgements.items():
                if camera not in judgement.cameras:
                    yield name, Finding("camera-missing", Use.DROP, text, f"camera {camera}")


def _late(judgements: Mapping[str, Judgement]) -> Iterator[tuple[str, Finding]]:
    """Episodes that are earlier or later behind their actions than all others.

    Hands that are slow in one episode are good; where streams are out of step, arms and hands are
    so by the same time.
    """
    figures = dict.fromkeys(f for j in judgements.values() for f in j.figures if f.startswith(_LAG))
    usual: dict[str, tuple[float, float]] = {}
    for figure in figures:
        values = np.array([j.figures[figure] for j in judgements.values() if figure in j.figures])
        if len(values) >= _EPISODES:
            middle = float(np.median(values))
            spread = 1.4826 * float(np.median(np.abs(values - middle)))
            usual[figure] = middle, max(_APART_S, _SPREADS * spread)
    for name, judgement in judgements.items():
        if any(f.check == "out-of-step" for f in judgement.reasons):
            continue
        off = {f: judgement.figures[f] - usual[f][0] for f in usual if f in judgement.figures}
        if not off:
            continue
        middle = float(np.median(list(off.values())))
        together = max(abs(v - middle) for v in off.values()) < _TOGETHER_S
        kinds = {"arm" in f for f in off}
        all_at_once = together and len(kinds) == 2
        if all_at_once and all(abs(v) > usual[f][1] for f, v in off.items()):
            worst, part = max(off, key=lambda f: abs(off[f])), ""
        else:
            worst = max(off, key=lambda f: abs(off[f]))
            part = worst.removeprefix(_LAG).removesuffix(", s").replace(" ", "_")
            if abs(off[worst]) < max(_APART_ALONE_S, usual[worst][1]):
                continue
        lag, middle = judgement.figures[worst], usual[worst][0]
        yield (
            name,
            Finding(
                "out-of-step",
                Use.REVIEW,
                f"the observation of {'the ' + part.replace('_', ' ') if part else 'all parts'} is "
                f"{lag:.2f} s behind its action, and {middle:.2f} s in the other episodes of the "
                "set",
                part,
                value=round(lag, 3),
                limit=round(middle + np.sign(off[worst]) * usual[worst][1], 3),
                unit="s",
            ),
        )
