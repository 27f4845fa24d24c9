"""The stimuli for hands and robots on DDS topics, as scripts (see
:mod:`dexkit.conformance.phased_script`).

Grippers have :mod:`~.stimuli.gripper`, hands of several joints :mod:`~.stimuli.fingers`; both
share :mod:`~.stimuli.hand`. Robots have :mod:`~.stimuli.robot`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from dexkit.conformance.requirements import Requirement, catalogue
from dexkit.conformance.stimuli.fingers import FingerScript
from dexkit.conformance.stimuli.gripper import GripperScript
from dexkit.conformance.stimuli.robot import RobotScript
from dexkit.conformance.stimuli.script import (
    Action,
    Join,
    Leave,
    Observation,
    Plan,
    Restart,
    Role,
    Script,
    Send,
    StartService,
    StopService,
)
from dexkit.conformance.stimuli.session import Session
from dexkit.models import DEX1_1, DEX3_1, DEX5_1
from dexkit.robots import G1, H1

__all__ = [
    "SCRIPTS",
    "Action",
    "Join",
    "Leave",
    "Observation",
    "Plan",
    "Restart",
    "Role",
    "Script",
    "Send",
    "Session",
    "StartService",
    "StopService",
    "phases_for",
    "script_for",
]

SCRIPTS: dict[str, type[Script]] = {
    DEX1_1.name: GripperScript,
    DEX3_1.name: FingerScript,
    DEX5_1.name: FingerScript,
    H1.name: RobotScript,
    G1.name: RobotScript,
}
"""The script of each model."""


def script_for(plan: Plan, say: Callable[[str], None] = lambda text: None) -> Script:
    """The script of the plan's model."""
    return SCRIPTS[plan.dialect.model](plan, say)


def phases_for(requirements: Iterable[Requirement]) -> frozenset[str]:
    """The phases that ``requirements`` and what they depend on need."""
    by_id = {r.id: r for r in catalogue(None, None)}
    todo = list(requirements)
    names: set[str] = set()
    seen: set[str] = set()
    while todo:
        requirement = todo.pop()
        if requirement.id in seen:
            continue
        seen.add(requirement.id)
        todo += [by_id[before] for before in requirement.after]
        if requirement.phase:
            names.add(requirement.phase)
        if requirement.needs == "session":
            names.add("replay")
        if requirement.needs == "motion":
            names.add(SCRIPTS[requirement.model].motion)
    return frozenset(names)
