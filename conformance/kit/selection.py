"""The kinds of a run: which requirements each judges; and print a selection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.requirements import Level, Requirement
from dexkit.conformance.kit.robot import robot_dialect
from dexkit.conformance.stimuli import Plan, phases_for, script_class
from dexkit.conformance.stimuli.script import default_objects
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


def length(model_name: str, phases: frozenset[str]) -> float:
    """Duration of these phases, s, with a pair of hands or a robot that reach every goal at once.

    The hands have the model's objects.
    """
    if model_name in ROBOTS:
        plan = Plan(robot_dialect(model_name), (ROBOT,), phases=phases)
        return script_class(model_name)(plan).length()
    dialect, sides = model(model_name).dialects[0], tuple(Side)
    objects = default_objects(dialect, sides)
    return script_class(model_name)(Plan(dialect, sides, objects, phases=phases)).length()


def quick(requirements: Sequence[Requirement]) -> tuple[Requirement, ...]:
    """Select the MUSTs of a quick run: those for which its phases are enough. Of several phases
    that one is judged in, those of a quick run count.
    """
    musts = [r for r in requirements if r.level is Level.MUST and r.layer != "usb"]
    chosen = [_within(r, _quick_phases(r.model)) for r in musts]
    return tuple(r for r in chosen if phases_for([r]) <= _quick_phases(r.model))


def _within(requirement: Requirement, phases: frozenset[str]) -> Requirement:
    """The requirement with those of its phases that are among some, if any are."""
    kept = [name for name in requirement.phases if name in phases]
    kind = requirement.needs.partition(":")[0]
    return replace(requirement, needs=f"{kind}:{' '.join(kept)}") if kept else requirement


def _quick_phases(model_name: str) -> frozenset[str]:
    return frozenset(under_test(model_name).quick_phases)


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
