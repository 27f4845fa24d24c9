"""Run a wrong hand on the virtual clock and judge it: one trial for each layer.

Services and robots go through the script for their model's topics, USB devices through that for
USB; both are judged against every requirement of the layer. Clients drive good hands through a
session, and are judged together with them: no requirement of the hands may fail.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Protocol

from dexkit.conformance.judge import judge, judge_layer
from dexkit.conformance.layers import layer, recording_of
from dexkit.conformance.mutants.registry import Mutant
from dexkit.conformance.requirements import Requirement, catalogue, select
from dexkit.conformance.results import Result, RunResult, Verdict
from dexkit.conformance.robot import robot_dialect
from dexkit.conformance.selection import RunKind
from dexkit.conformance.stimuli import CommandSession, Plan, phases_for, script_class
from dexkit.conformance.stimuli.operator import OPERATOR
from dexkit.conformance.stimuli.script import default_objects
from dexkit.conformance.virtual import TopicDevice, run_virtual
from dexkit.conformance.virtual.client import run_client
from dexkit.conformance.virtual.usb import ReferenceDevice, run_virtual_usb
from dexkit.hand import ROBOT, Side, Subject
from dexkit.models import DEX1_1, dialect, model
from dexkit.robots import ROBOTS

__all__ = ["Trial", "plan_for", "run_mutant", "run_usb_mutant"]

SESSION_SECONDS = 4.0
_BLAMES = (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)


class Trial(Protocol):
    """How the wrong hands of a layer are run and judged."""

    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""

    def blamed(self, mutant: Mutant, *, short: bool) -> set[str]:
        """The requirements that fail or warn.

        :param short: apply only the phases that show the fault, where that is fair.
        """


@cache
def _session(model_name: str) -> CommandSession | None:
    if not model(model_name).session:
        return None
    return CommandSession.default(model_name).first_seconds(SESSION_SECONDS)


def plan_for(
    name: str = DEX1_1.dialects[0].name,
    *,
    sides: Sequence[Subject] | None = None,
    run: RunKind = RunKind.DEFAULT,
) -> Plan[Subject]:
    """Every phase that such a run has; for hands with a session to replay and an object in the
    right hand.

    :param name: of a dialect or a robot.
    :param sides: by default both hands, or the robot; both where no command can leave one alone.
    """
    if name in ROBOTS:
        every = run.requirements(catalogue(name, "robot"))
        return Plan(robot_dialect(name), (ROBOT,), phases=phases_for(every))
    chosen = dialect(name)
    sides = tuple(Side) if sides is None or chosen.commands_both else tuple(sides)
    return Plan(
        dialect=chosen,
        sides=sides,
        objects=default_objects(chosen, sides),
        session=_session(chosen.model),
        phases=phases_for(run.requirements(catalogue(chosen.model))),
        rounds=run.rounds,
    )


def run_mutant(
    service: type[TopicDevice],
    plan: Plan[Subject] | None = None,
    requirements: Sequence[Requirement] | None = None,
) -> RunResult:
    """Judge a service of hands, or a robot, on the virtual clock.

    :param requirements: those to be reported; None for all.
    """
    chosen = plan or plan_for()
    trace = run_virtual(chosen, service)
    recording = recording_of(trace, chosen.dialect.name, chosen.sides)
    subject = {"backend": f"virtual {service.__name__}", "device": "virtual"}
    return judge(recording, requirements=requirements, subject=subject)


def run_usb_mutant(
    device: type[ReferenceDevice], requirements: Sequence[Requirement], side: Side = Side.LEFT
) -> list[Result]:
    """Judge a USB device on the virtual clock."""
    usb = layer("usb")
    recording = usb.decode(run_virtual_usb(device(side)), None, ())
    return judge_layer(usb, recording, requirements)


def _blamed(results: Sequence[Result]) -> set[str]:
    return {r.requirement.id for r in results if r.verdict in _BLAMES}


class TopicTrial(ABC):
    """Trial of a wrong hand on DDS topics."""

    @abstractmethod
    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""

    def blamed(self, mutant: Mutant, *, short: bool) -> set[str]:
        """The requirements that fail or warn."""
        return _blamed(run_mutant(mutant.made, self.plan(mutant, short=short)).results)

    def plan(self, mutant: Mutant, *, short: bool = False) -> Plan[Subject]:
        """The phases that show the fault: all, or those that its requirements need."""
        full = self._full(mutant)
        every = catalogue(mutant.model, mutant.layer)
        if mutant.brief or (short and not mutant.whole):
            needed = select(every, prefixes=[mutant.kills, *mutant.also])
            return replace(full, phases=self._short(mutant, needed))
        if not any(r.id == mutant.kills and r.phase == OPERATOR for r in every):
            # six seconds without a finding that other phases do not give
            full = replace(full, phases=full.phases - {OPERATOR})
        return full

    @abstractmethod
    def _full(self, mutant: Mutant) -> Plan[Subject]:
        """Every phase."""

    @abstractmethod
    def _short(self, mutant: Mutant, needed: Sequence[Requirement]) -> frozenset[str]:
        """The phases that those requirements need."""


class HandTrial(TopicTrial):
    """On the topics of hands."""

    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""
        one_joint = len(model(mutant.model).joints[Side.LEFT]) == 1
        return len(mutant.sides) * (1 if mutant.brief else 3) * (1 if one_joint else 2)

    def _full(self, mutant: Mutant) -> Plan[Subject]:
        name = mutant.dialect or model(mutant.model).dialects[0].name
        return plan_for(name, sides=mutant.sides)

    def _short(self, mutant: Mutant, needed: Sequence[Requirement]) -> frozenset[str]:
        # always moved: some faults show only then
        return phases_for(needed) | {script_class(mutant.model).motion}


class RobotTrial(TopicTrial):
    """On the topics of a robot."""

    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""
        return 4.0

    def _full(self, mutant: Mutant) -> Plan[Subject]:
        return plan_for(mutant.model)

    def _short(self, mutant: Mutant, needed: Sequence[Requirement]) -> frozenset[str]:
        # every joint in turn takes by far the longest
        motion = {script_class(mutant.model).motion}
        return phases_for(needed) - (motion - {r.phase for r in needed})


class UsbTrial:
    """On a hand's USB device."""

    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""
        return 0.5

    def blamed(self, mutant: Mutant, *, short: bool) -> set[str]:
        """The requirements that fail or warn; the script has no short form."""
        every = catalogue(mutant.model, mutant.layer)
        (side,) = mutant.sides
        assert isinstance(side, Side), "a robot has no USB device"
        return _blamed(run_usb_mutant(mutant.made, every, side))


class ClientTrial:
    """Trial of a wrong client in a session with good hands."""

    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""
        return 1.0 if len(model(mutant.model).joints[Side.LEFT]) == 1 else 4.0

    def blamed(self, mutant: Mutant, *, short: bool) -> set[str]:
        """The requirements that fail or warn, the hands' included; there is no short form."""
        spoken = dialect(mutant.dialect) if mutant.dialect else model(mutant.model).dialects[0]
        trace = run_client(mutant.made, spoken)
        recording = layer(mutant.layer).decode(trace, spoken.name, ())
        assert recording is not None, "only USB may be missing from a recording"
        result = judge(recording)
        return _blamed([*result.results, *result.client])
