"""Which requirements a run is about: by id, by level, by what is claimed, by how long they take."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from dexkit.conformance.requirements import Level, Requirement
from dexkit.conformance.stimuli import SCRIPTS, Plan, phases_for
from dexkit.hand import Side
from dexkit.models import DEX1_1, DEX3_1, model

__all__ = ["QUICK", "length", "print_selection", "quick"]

QUICK = {DEX1_1.name: 9.0, DEX3_1.name: 15.0}
"""Seconds of stimulus of a quick run; starting a pair of hands and judging take some more."""


@cache
def length(model_name: str, phases: frozenset[str]) -> float:
    """Seconds that a pair of hands which obey at once takes for these phases."""
    dialect = model(model_name).dialects[0]
    return SCRIPTS[model_name](Plan(dialect, tuple(Side), phases=phases)).length()


def quick(requirements: Sequence[Requirement]) -> tuple[Requirement, ...]:
    """The MUSTs that need no long observation.

    Those with the shortest stimulus first, as long as all their stimuli together take no more
    than :data:`QUICK` seconds. Those that need a recorded session are too long.
    """
    chosen: set[str] = set()
    for name in dict.fromkeys(r.model for r in requirements):
        musts = [
            (r.id, phases_for([r]))
            for r in requirements
            if (r.model, r.layer, r.level) == (name, "dds", Level.MUST)
        ]
        short = [(length(name, own), id_, own) for id_, own in musts if "replay" not in own]
        phases: frozenset[str] = frozenset()
        for _, id_, own in sorted(short, key=lambda candidate: candidate[0]):
            if length(name, phases | own) <= QUICK[name]:
                phases |= own
                chosen.add(id_)
    return tuple(r for r in requirements if r.id in chosen)


def print_selection(requirements: Sequence[Requirement]) -> None:
    """Print id, level, title, how sure the source is, the stimulus, and the unit, if any."""
    rows = [("requirement", "level", "title", "confidence", "stimulus", "unit")]
    rows += [
        (r.id, str(r.level), r.title, r.confidence, r.needs, r.capability) for r in requirements
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip())
    print(f"{len(requirements)} requirements")
