"""Deliberately wrong hands, robots and USB devices: each has one fault, and the checks must find
exactly that.

A wrong hand is a small change of a reference that meets every requirement, declared by the
decorator :func:`~dexkit.conformance.mutants.registry.wrong_hand`.
"""

from __future__ import annotations

from functools import cache

from dexkit.conformance.mutants import any_model, fingers, gripper, operator, robot, usb
from dexkit.conformance.mutants.registry import Mutant, expand
from dexkit.conformance.mutants.trials import plan_for, run_mutant

__all__ = ["MODULES", "Mutant", "mutants", "plan_for", "run_mutant"]

MODULES = (any_model, gripper, fingers, operator, robot, usb)
"""Where wrong hands are declared."""


@cache
def mutants(layer: str | None = None) -> tuple[Mutant, ...]:
    """Every wrong hand.

    :param layer: only those of that layer.
    """
    if layer is None:
        return expand()
    return tuple(m for m in mutants() if m.layer == layer)
