"""Play a wrong hand on the virtual clock and judge the recording: one kind of trial a layer.

Services and robots go through the script for their model's topics, USB devices through that for
USB; both are judged against every requirement of the layer. Clients drive good hands through a
session, and are judged together with them: no requirement of the hands may fail.

To play and to judge are functions of their arguments alone, and name nothing that the other needs:
what is known of one stays true while the other is changed (``make pins``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from dexkit.conformance.behaviours.operator import OPERATOR
from dexkit.conformance.faults.registry import Mutant
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import deciding, judge, judge_layer, results_of
from dexkit.conformance.kit.recording import TraceLike
from dexkit.conformance.kit.requirements import Requirement, catalogue, select
from dexkit.conformance.kit.results import Result, RunResult, Verdict
from dexkit.conformance.kit.robot import robot_dialect
from dexkit.conformance.kit.selection import RunKind
from dexkit.conformance.layers import layer
from dexkit.conformance.stimuli import CommandSession, Plan, phases_for, script_class
from dexkit.conformance.stimuli.script import default_objects
from dexkit.conformance.virtual import TopicDevice, run_virtual
from dexkit.conformance.virtual.client import run_client
from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.conformance.virtual.usb import run_virtual_usb
from dexkit.hand import ROBOT, Side, Subject
from dexkit.models import DEX1_1, DEX3_1, Dialect, dialect, model
from dexkit.robots import ROBOTS

__all__ = [
    "BLAMES",
    "Run",
    "blamed",
    "blamed_in",
    "cost",
    "judge_client",
    "judge_topics",
    "judge_usb",
    "plan_for",
    "play_client",
    "play_topics",
    "play_usb",
    "run_mutant",
    "run_of",
    "topic_plan",
]

BLAMES = (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)
"""The verdicts that blame a hand."""


@dataclass(frozen=True)
class Run:
    """A run of a wrong hand, and how it is judged.

    :param made: the wrong hand.
    :param about: what is played and judged besides: a plan, a side or a dialect.
    :param play: makes a recording of both.
    :param judge: judges it by every requirement of the layer, and a client's by the hands' too; or
        by those with some ids alone, and those that decide about them.
    """

    made: type[Any]
    about: Any
    play: Callable[[type[Any], Any], MemoryTrace]
    judge: Callable[[TraceLike, Any, Collection[str] | None], list[Result]]


def run_of(mutant: Mutant, *, short: bool = False) -> Run:
    """The run of a wrong hand.

    :param short: apply only the phases that show the fault, where that is fair. A USB device and a
        client have no short form.
    """
    if mutant.layer == "usb":
        (side,) = mutant.sides
        return Run(mutant.made, side, play_usb, judge_usb)
    if mutant.layer == "client":
        spoken = dialect(mutant.dialect) if mutant.dialect else model(mutant.model).dialects[0]
        return Run(mutant.made, spoken, play_client, judge_client)
    return Run(mutant.made, topic_plan(mutant, short=short), play_topics, judge_topics)


def blamed(mutant: Mutant, *, short: bool = False) -> set[str]:
    """Try a wrong hand: the requirements that fail or warn."""
    run = run_of(mutant, short=short)
    return blamed_in(run.judge(run.play(run.made, run.about), run.about, None))


def blamed_in(results: Iterable[Result]) -> set[str]:
    """The requirements that fail or warn in these results."""
    return {r.requirement.id for r in results if r.verdict in BLAMES}


def cost(mutant: Mutant) -> float:
    """Roughly how long a trial takes, in units of the shortest on DDS."""
    if mutant.layer == "usb":
        return 0.5
    if mutant.layer == "robot":
        return 4.0
    one_joint = len(model(mutant.model).joints[Side.LEFT]) == 1
    if mutant.layer == "client":
        return 1.0 if one_joint else 4.0
    return len(mutant.sides) * (1 if mutant.brief else 3) * (1 if one_joint else 2)


# --------------------------------------------------------------------------------------- plans


@cache
def _session(model_name: str) -> CommandSession | None:
    if not under_test(model_name).session:
        return None
    return CommandSession.default(model_name)


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


def topic_plan(mutant: Mutant, *, short: bool = False) -> Plan[Subject]:
    """The phases that a hand's or a robot's run has: all, or in a short run those that the
    requirements need which the fault is known to break.
    """
    robot = mutant.layer == "robot"
    name = mutant.model if robot else mutant.dialect or model(mutant.model).dialects[0].name
    full = plan_for(name, sides=mutant.sides)
    every = catalogue(mutant.model, mutant.layer)
    if mutant.brief or (short and not mutant.whole):
        needed = select(every, prefixes=sorted(mutant.pinned or {mutant.kills}))
        phases, motion = phases_for(needed), {script_class(mutant.model).motion}
        if robot:
            # every joint in turn takes by far the longest
            return replace(
                full, phases=phases - (motion - {name for r in needed for name in r.phases})
            )
        # always moved: some faults show only then
        return replace(full, phases=phases | motion)
    if not any(r.id == mutant.kills and r.phase == OPERATOR for r in every):
        # six seconds without a finding that other phases do not give
        full = replace(full, phases=full.phases - {OPERATOR})
    return full


def run_mutant(
    service: type[TopicDevice],
    plan: Plan[Subject] | None = None,
    requirements: Sequence[Requirement] | None = None,
    claims: Claims | None = None,
) -> RunResult:
    """Judge a service of hands, or a robot, on the virtual clock.

    :param requirements: those to be reported; None for all.
    :param claims: what the vendor claims of the hand.
    """
    chosen = plan or plan_for()
    trace = run_virtual(chosen, service)
    recording = recording_of(trace, chosen.dialect.name, chosen.sides)
    subject = {"backend": f"virtual {service.__name__}", "device": "virtual"}
    return judge(recording, requirements=requirements, claims=claims, subject=subject)


# ----------------------------------------------------------------------------- to play and judge


def play_topics(made: type[Any], plan: Plan[Subject]) -> MemoryTrace:
    """Record a service of hands, or a robot, going through the phases of a plan."""
    return run_virtual(plan, made)


def judge_topics(
    trace: TraceLike, plan: Plan[Subject], only: Collection[str] | None
) -> list[Result]:
    """Judge the recording of a service; for ``only`` see :class:`Run`."""
    recording = recording_of(trace, plan.dialect.name, plan.sides)
    client, results = results_of(recording, only=only)
    return [*client, *results]


def play_usb(made: type[Any], side: Side) -> MemoryTrace:
    """Record a USB device."""
    return run_virtual_usb(made(side))


def judge_usb(trace: TraceLike, side: Side, only: Collection[str] | None) -> list[Result]:
    """Judge the recording of a USB device."""
    usb, model_name = layer("usb"), DEX3_1.name
    every = catalogue(model_name, "usb")
    if only is not None:
        chosen = {r.id for name in only for r in deciding(model_name, name)}
        every = tuple(r for r in every if r.id in chosen)
    return judge_layer(usb, usb.decode(trace, None, ()), every)


def play_client(made: type[Any], spoken: Dialect) -> MemoryTrace:
    """Record a client in a session with good hands."""
    return run_client(made, spoken)


def judge_client(trace: TraceLike, spoken: Dialect, only: Collection[str] | None) -> list[Result]:
    """Judge the recording of a client's session: the client and the hands."""
    recording = layer("client").decode(trace, spoken.name, ())
    assert recording is not None, "only USB may be missing from a recording"
    client, results = results_of(recording, only=only)
    return [*client, *results]
