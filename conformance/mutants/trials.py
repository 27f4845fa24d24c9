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

from dexkit.conformance.hands import under_test
from dexkit.conformance.judge import judge
from dexkit.conformance.layers import layer, recording_of
from dexkit.conformance.mutants.registry import Mutant
from dexkit.conformance.mutants.runs import (
    Run,
    judge_client,
    judge_topics,
    judge_usb,
    play_client,
    play_topics,
    play_usb,
)
from dexkit.conformance.requirements import Requirement, catalogue, select
from dexkit.conformance.results import RunResult, Verdict
from dexkit.conformance.robot import robot_dialect
from dexkit.conformance.selection import RunKind
from dexkit.conformance.stimuli import CommandSession, Plan, phases_for, script_class
from dexkit.conformance.stimuli.operator import OPERATOR
from dexkit.conformance.stimuli.script import default_objects
from dexkit.conformance.virtual import TopicDevice, run_virtual
from dexkit.hand import ROBOT, Side, Subject
from dexkit.models import DEX1_1, dialect, model
from dexkit.robots import ROBOTS

__all__ = ["BLAMES", "Trial", "blamed", "plan_for", "run_mutant", "trial_of"]

SESSION_SECONDS = 4.0
BLAMES = (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)
"""The verdicts that blame a hand."""


class Trial(Protocol):
    """How the wrong hands of a layer are run and judged."""

    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""

    def run(self, mutant: Mutant, *, short: bool = False) -> Run:
        """Its run.

        :param short: apply only the phases that show the fault, where that is fair.
        """


def trial_of(mutant: Mutant) -> Trial:
    """How a wrong hand is tried."""
    trial: Trial = layer(mutant.layer).trial.load()()
    return trial


def blamed(mutant: Mutant, *, short: bool = False) -> set[str]:
    """Try a wrong hand: the requirements that fail or warn."""
    run = trial_of(mutant).run(mutant, short=short)
    results = run.judge(run.play(run.made, run.about), run.about, None)
    return {r.requirement.id for r in results if r.verdict in BLAMES}


@cache
def _session(model_name: str) -> CommandSession | None:
    if not under_test(model_name).session:
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


class TopicTrial(ABC):
    """Trial of a wrong hand on DDS topics."""

    @abstractmethod
    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""

    def run(self, mutant: Mutant, *, short: bool = False) -> Run:
        """Its run, going through its plan."""
        return Run(mutant.made, self.plan(mutant, short=short), play_topics, judge_topics)

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

    def run(self, mutant: Mutant, *, short: bool = False) -> Run:
        """Its run; the script has no short form."""
        (side,) = mutant.sides
        return Run(mutant.made, side, play_usb, judge_usb)


class ClientTrial:
    """Trial of a wrong client in a session with good hands."""

    def cost(self, mutant: Mutant) -> float:
        """Roughly how long a run takes, in units of the shortest on DDS."""
        return 1.0 if len(model(mutant.model).joints[Side.LEFT]) == 1 else 4.0

    def run(self, mutant: Mutant, *, short: bool = False) -> Run:
        """Its session; there is no short form."""
        spoken = dialect(mutant.dialect) if mutant.dialect else model(mutant.model).dialects[0]
        return Run(mutant.made, spoken, play_client, judge_client)
