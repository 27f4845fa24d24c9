"""What the kit needs to judge a model, beside the facts in its profile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.lazy import Lazy
from dexkit.models import HandModel
from dexkit.robots import RobotModel

__all__ = ["JointRoles", "ModelUnderTest"]


@dataclass(frozen=True)
class JointRoles:
    """Joints that the stimulus uses, by index, for a hand of several joints.

    :param driven: driven by a velocity when the commands stop.
    :param slow: slowly on their way to a position when the commands stop.
    :param crossed: two joints that get each other's id in the mode byte; the first is commanded to
        move. Their limits are equal, so that a hand that goes by the id can move the other one.
    """

    driven: tuple[int, ...]
    slow: tuple[int, ...]
    crossed: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class ModelUnderTest:
    """How the kit judges a hand or a robot.

    :param requirements: its requirement files, of a model of another package.
    :param prefixes: of a model of dexkit itself, layer of its requirements by the prefix of their
        ids, which :mod:`dexkit.conformance.behaviours` holds.
    :param script: its stimulus script: a :class:`~dexkit.conformance.stimuli.script.Script`.
    :param reference: service on a virtual clock that does everything right.
    :param quick_phases: phases of a quick run, some eleven seconds: those by which most known wrong
        hands fail. A MUST that needs any other phase is not judged in it.
    :param roles: joints that the script uses; None for a gripper and a robot.
    :param objects: where the hands of a pair that the kit starts have an object; percent of
        opening for a gripper, of closing for others.
    :param session: the recorded session to replay: name of a sample of dexkit, or path of a
        recording; empty where there is none.
    :param wrong_hands: the module with the wrong hands of another package's model, which have the
        decorator ``dexkit.conformance.faults.wrong_hand``; None where the shared ones prove its
        requirements.
    :raises UsageError: a file has no name, or a hand of several joints has no roles.
    """

    model: HandModel | RobotModel
    script: Lazy[type[Any]]
    reference: Lazy[type[Any]]
    quick_phases: tuple[str, ...]
    requirements: tuple[str | Path, ...] = ()
    prefixes: Mapping[str, str] = field(default_factory=dict)
    roles: JointRoles | None = None
    objects: Mapping[Side, float] = field(default_factory=dict)
    session: str | Path = ""
    wrong_hands: Lazy[ModuleType] | None = None

    def __post_init__(self) -> None:
        if not all(self.requirements):
            raise UsageError(f"{self.model.name}: a requirement file has no name")
        several = isinstance(self.model, HandModel) and not self.model.dialects[0].is_gripper
        if several and self.roles is None:
            raise UsageError(f"{self.model.name}: a hand of several joints needs joint roles")
