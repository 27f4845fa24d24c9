"""The stimuli as scripts (see :mod:`dexkit.conformance.kit.phased_script`).

The phases are beside the checks that judge by them, in :mod:`dexkit.conformance.behaviours`. Here
is what puts them in order (:mod:`~.stimuli.phases`), and what they are written with: for DDS topics
:mod:`~.stimuli.script`, with :mod:`~.stimuli.hand` for hands, :mod:`~.stimuli.gripper` for
grippers, :mod:`~.stimuli.fingers` for hands of several joints and :mod:`~.stimuli.robot` for
robots; for hands on USB :mod:`~.stimuli.usb`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.layers import layer_of_model
from dexkit.conformance.stimuli.recorded_session import CommandSession
from dexkit.conformance.stimuli.script import (
    Action,
    Join,
    Leave,
    Observation,
    Plan,
    Restart,
    Role,
    S,
    Script,
    Send,
    StartService,
    StopService,
)

__all__ = [
    "Action",
    "CommandSession",
    "Join",
    "Leave",
    "Observation",
    "Plan",
    "Restart",
    "Role",
    "Script",
    "Send",
    "StartService",
    "StopService",
    "phases_for",
    "script_class",
    "script_for",
]


def script_class(model_name: str) -> type[Script[Any]]:
    """The script of a hand model or robot; the model decides for which subjects."""
    made: type[Script[Any]] = layer_of_model(model_name).script(model_name)
    return made


def script_for(plan: Plan[S], report: Callable[[str], None] = lambda text: None) -> Script[S]:
    """The script of the plan's model."""
    return script_class(plan.dialect.model)(plan, report)


def phases_for(requirements: Iterable[Requirement]) -> frozenset[str]:
    """The phases that ``requirements`` and what they depend on need."""
    todo = list(requirements)
    by_id = {r.id: r for name in {r.model for r in todo} for r in catalogue(name, None)}
    names: set[str] = set()
    seen: set[str] = set()
    while todo:
        requirement = todo.pop()
        if requirement.id in seen:
            continue
        seen.add(requirement.id)
        todo += [by_id[before] for before in requirement.after]
        names.update(requirement.phases)
        if requirement.needs == "session":
            names.add("replay")
        if requirement.needs == "motion":
            names.add(script_class(requirement.model).motion)
    return frozenset(names)
