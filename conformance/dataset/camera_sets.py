"""Cameras of an episode against the same cameras in the other episodes of a set."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dexkit.conformance.dataset.findings import Finding, Judgement, Use

__all__ = ["never_moving"]

_SEEN = "motion seen by "
_EPISODES = 5  # from which it can be told what a camera sees
_LEAST_SEEN = 30.0  # % of the joints' motion, in half of the other episodes


def never_moving(judgements: Mapping[str, Judgement]) -> Iterator[tuple[str, Finding]]:
    """Episodes in which a picture never moves, of cameras that see motion in the others.

    A single episode cannot tell this from a camera that sees nothing that moves.
    """
    figures = dict.fromkeys(
        f for j in judgements.values() for f in j.figures if f.startswith(_SEEN)
    )
    for figure in figures:
        seen = {n: j.figures[figure] for n, j in judgements.items() if figure in j.figures}
        for name, share in seen.items():
            others = [s for n, s in seen.items() if n != name]
            if share > 0 or len(others) < _EPISODES or _is_told(judgements[name]):
                continue
            usual = float(np.median(others))
            if usual < _LEAST_SEEN:
                continue
            text = (
                "its picture never moves while all arms do; in the other episodes of the set it "
                f"moves in {usual:.0f} % of their motion: the camera froze before the start"
            )
            part = figure.removeprefix(_SEEN).removesuffix(", %")
            yield (
                name,
                Finding(
                    "camera-frozen", Use.REVIEW, text, part, value=share, limit=usual, unit="%"
                ),
            )


def _is_told(judgement: Judgement) -> bool:
    return any(f.check.startswith("camera") for f in judgement.reasons)
