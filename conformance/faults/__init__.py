"""Deliberately wrong hands, robots, USB devices and clients: each has one fault, and the checks
must find exactly that.

A wrong hand is a small change of a reference that meets every requirement, declared by the
decorator :func:`~dexkit.conformance.faults.registry.wrong_hand`. They are for the work on the
checks: the wheel does not hold them.
"""

from __future__ import annotations

from functools import cache

from dexkit.conformance.faults import (
    any_model,
    clients,
    dex5,
    fingers,
    gripper,
    operator,
    robot,
    servos,
    touch,
    usb,
)
from dexkit.conformance.faults.registry import Mutant, expand, wrong_hand
from dexkit.conformance.faults.trials import plan_for, run_mutant
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.requirements import models

__all__ = ["MODULES", "Mutant", "mutants", "plan_for", "run_mutant", "wrong_hand"]

MODULES = (any_model, gripper, fingers, servos, touch, operator, clients, robot, usb, dex5)
"""The modules that declare wrong hands."""


@cache
def mutants(layer: str | None = None) -> tuple[Mutant, ...]:
    """Every wrong hand: of the modules here, and of those of single models.

    :param layer: only those of that layer.
    :raises ModelBroken: the wrong hands of another package's model cannot be loaded.
    """
    if layer is None:
        for name in models():
            if own := under_test(name).wrong_hands:
                own.load()
        return expand()
    return tuple(m for m in mutants() if m.layer == layer)
