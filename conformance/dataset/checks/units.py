"""Whether positions are in the unit that the hand or arm has, and state and action in the same."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexkit.conformance.dataset.check import Check, Data
from dexkit.conformance.dataset.checks.assignment import assigned
from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import part_text
from dexkit.conformance.dataset.relation import Relation, relations
from dexkit.conformance.dataset.unit_fit import Units, is_radians, other_units, wrong_units

__all__ = ["CHECKS"]

_ZERO = 0.35  # rad, or of the stroke, that a zero is off, if it is: gravity takes 0.1


def _units(episode: Episode) -> Iterator[Finding]:
    yield from (f for f in assigned(episode) if f.check == "units")
    done = set()
    for r in relations(episode):
        done.add(r.part)
        if r.increments:
            continue
        found = other_units(r) or wrong_units(episode, r.track)
        if found is not None:
            yield _finding(r.track, found)
        elif (moved := _zero(r)) is not None:
            yield moved
    for track in episode.tracks:
        if track.part not in done and (found := wrong_units(episode, track)) is not None:
            yield _finding(track, found)


def _finding(track: Track, found: Units) -> Finding:
    words = {"state": "the observation is", "action": "the action is"}.get(
        found.which, "observation and action are"
    )
    unit = "in radians" if is_radians(track) else "0 to 1"
    sure = "almost certain" if found.sure > 0.93 else "likely"
    return Finding(
        "units",
        Use.REVIEW if found.which == "state and action" else Use.DROP,
        f"{part_text(track.part)}: {words} {found.text}, not {unit} ({sure})",
        part=track.part,
        value=round(found.sure, 3),
    )


def _zero(r: Relation) -> Finding | None:
    """Joints whose zero is another one in state and action."""
    least = np.where(r.track.is_hand, _ZERO * r.stroke, _ZERO)
    m = r.moments
    if (np.abs(m.mean_s - m.mean_a) < least).all():
        return None
    slope, _ = r.fit
    state, action = r.pair
    away = np.median(state - action, axis=0)
    like = (r.own > 0.95) & (slope > 0.8) & (slope < 1.25) & r.moving
    found = np.flatnonzero(like & (np.abs(away) > least)).tolist()
    if not found:
        return None
    worst = float(np.abs(away[found]).max())
    return Finding(
        "units",
        Use.REVIEW,
        f"{part_text(r.part)}: the observation follows the action at a constant distance of "
        f"{worst:.2f}: they have different zeros",
        part=r.part,
        joints=tuple(found),
        value=worst,
        limit=_ZERO,
    )


CHECKS = (Check("units", "Positions in another unit", frozenset({Data.STATE}), _units),)
