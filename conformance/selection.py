"""The kinds of a run: which requirements each judges; and print a selection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from functools import cache

from dexkit.conformance.requirements import Level, Requirement
from dexkit.conformance.robot import robot_dialect
from dexkit.conformance.stimuli import Plan, phases_for, script_class
from dexkit.hand import ROBOT, Side
from dexkit.models import model
from dexkit.robots import ROBOTS

__all__ = ["THOROUGH_ROUNDS", "RunKind", "length", "print_selection", "quick"]

THOROUGH_ROUNDS = 12
"""Rounds of a thorough run: about ten minutes of stimulus for a pair of grippers."""


class RunKind(str, Enum):
    """Extent of a run of the suite."""

    QUICK = "quick"
    DEFAULT = "default"
    THOROUGH = "thorough"

    def __str__(self) -> str:
        return self.value

    @property
    def rounds(self) -> int:
        """Number of times that a hand gets the stimuli."""
        return THOROUGH_ROUNDS if self is RunKind.THOROUGH else 1

    def requirements(self, every: Sequence[Requirement]) -> tuple[Requirement, ...]:
        """Those of ``every`` that such a run judges."""
        return quick(every) if self is RunKind.QUICK else tuple(every)


@cache
def length(model_name: str, phases: frozenset[str], at_most: float = math.inf) -> float:
    """Duration of these phases, s, with hands or a robot that reach every goal at once.

    :param at_most: s; of phases that are longer it is only some number above this.
    """
    if model_name in ROBOTS:
        plan = Plan(robot_dialect(model_name), (ROBOT,), phases=phases)
        return script_class(model_name)(plan).length(at_most)
    dialect = model(model_name).dialects[0]
    return script_class(model_name)(Plan(dialect, tuple(Side), phases=phases)).length(at_most)


def quick(requirements: Sequence[Requirement]) -> tuple[Requirement, ...]:
    """Select the MUSTs of a quick run.

    Phases are added in the order of their duration per MUST, until the profile's
    ``quick_seconds`` are used up. Requirements that need a recorded session are left out.
    """
    chosen: set[str] = set()
    for name in dict.fromkeys(r.model for r in requirements):
        needs: dict[frozenset[str], list[str]] = {}
        for r in requirements:
            if (r.model, r.level) == (name, Level.MUST) and r.layer != "usb":
                own = phases_for([r])
                if "replay" not in own:
                    needs.setdefault(own, []).append(r.id)
        budget = (ROBOTS.get(name) or model(name)).quick_seconds
        least = length(name, frozenset()) - 0.1  # s; requirements that need no stimulus come first
        lengths = {own: length(name, own, budget) for own in needs}
        # what is too long alone fits in with nothing
        short = [own for own in needs if lengths[own] <= budget]
        phases: frozenset[str] = frozenset()
        for own in sorted(short, key=lambda o: (lengths[o] - least) / len(needs[o])):
            if length(name, phases | own, budget) <= budget:
                phases |= own
        chosen |= {id_ for own, ids in needs.items() if own <= phases for id_ in ids}
    return tuple(r for r in requirements if r.id in chosen)


def print_selection(requirements: Sequence[Requirement]) -> None:
    """Print a table: id, level, title, confidence, stimulus and unit of each requirement."""
    rows = [("requirement", "level", "title", "confidence", "stimulus", "unit")]
    rows += [
        (r.id, str(r.level), r.title, r.confidence, r.needs, r.capability) for r in requirements
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip())
    print(f"{len(requirements)} requirements")
