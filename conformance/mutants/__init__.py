"""Deliberately wrong hands: each does one thing wrong, and the checks must notice exactly that.

A mutant is a small change of its model's reference service or of its hand. :attr:`Mutant.kills` is
the requirement that must catch it; ``also`` names what cannot but fail with it. No other
requirement may fail or warn: it would be caught for the wrong reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

from dexkit.conformance.judge import judge
from dexkit.conformance.mutants import fingers, gripper, operator, shared
from dexkit.conformance.recording import Recording
from dexkit.conformance.requirements import catalogue, select
from dexkit.conformance.results import RunResult, Verdict
from dexkit.conformance.stimuli import SCRIPTS, Plan, Session, phases_for
from dexkit.conformance.stimuli.operator import OPERATOR
from dexkit.conformance.stimuli.script import default_objects
from dexkit.conformance.virtual import Service, run_virtual
from dexkit.conformance.virtual.fingers import Dex3Service, Dex5Service
from dexkit.conformance.virtual.gripper import ReferenceService
from dexkit.hand import Side
from dexkit.models import DEX1_1, DEX3_1, DEX5_1, dialect, model

__all__ = ["MUTANTS", "Mutant", "plan_for", "run_mutant", "trial"]

SESSION_SECONDS = 4.0
LEFT = (Side.LEFT,)


@dataclass(frozen=True)
class Mutant:
    """One wrong hand.

    :param model: the hand model that it is a bad copy of.
    :param kills: the requirement that must catch it.
    :param also: requirements that fail or warn with it.
    :param sides: the hands that are needed to see it.
    :param brief: only the phases that its requirement needs are gone through: it does everything
        right and only tells of it wrongly, or it is a wrong hand of any model, and another
        model's has gone through all of them.
    :param dialect: where it is wrong in one dialect only; empty for the model's first.
    """

    name: str
    model: str
    service: type[Service]
    kills: str
    also: tuple[str, ...] = ()
    sides: tuple[Side, ...] = tuple(Side)
    brief: bool = False
    dialect: str = ""

    @property
    def plan(self) -> Plan:
        """The stimulus that shows it: all of it, or what its requirement needs."""
        full = plan_for(self.dialect or model(self.model).dialects[0].name, sides=self.sides)
        if "-OPER-" not in self.kills:
            # eleven seconds that show an operator what the other phases show already
            full = replace(full, phases=full.phases - {OPERATOR})
        return self.short_plan if self.brief else full

    @property
    def short_plan(self) -> Plan:
        """No more than what shows it."""
        full = plan_for(self.dialect or model(self.model).dialects[0].name, sides=self.sides)
        wanted = select(catalogue(self.model), prefixes=[self.kills, *self.also])
        return replace(full, phases=phases_for(wanted) | {SCRIPTS[self.model].motion})

    @property
    def summary(self) -> str:
        """What it does wrong, in a line."""
        return (self.service.__doc__ or "").strip().splitlines()[0]


def _dex1(service: type[Service], kills: str, also: tuple[str, ...]) -> Mutant:
    name = service.__name__
    sides = LEFT if name in gripper.ALONE else tuple(Side)
    spoken = gripper.DIALECTS.get(name, "")
    return Mutant(name, DEX1_1.name, service, kills, also, sides, dialect=spoken)


def _fingers(hand: str, service: type[Service], kills: str, also: tuple[str, ...]) -> Mutant:
    name = service.__name__
    sides = tuple(Side) if name in fingers.BOTH else LEFT
    brief = name in fingers.TOLD or (hasattr(shared, name) and name not in shared.DILUTED)
    return Mutant(name, hand, service, kills, also, sides, brief)


MUTANTS: tuple[Mutant, ...] = (
    *(_dex1(*entry) for entry in (*gripper.ZOO, *operator.ZOO[DEX1_1.name])),
    *(
        _fingers(hand, *entry)
        for hand, zoo in fingers.ZOOS.items()
        for entry in (*zoo, *operator.ZOO[hand])
    ),
)
REFERENCES: dict[str, type[Service]] = {
    DEX1_1.name: ReferenceService,
    DEX3_1.name: Dex3Service,
    DEX5_1.name: Dex5Service,
}
"""The good hand of each model."""


@cache
def _session(model_name: str) -> Session:
    return Session.default(model_name).first_seconds(SESSION_SECONDS)


def plan_for(dialect_name: str = "unitree_go", *, sides: Sequence[Side] = tuple(Side)) -> Plan:
    """Every stimulus, with an object in the right hand."""
    chosen = dialect(dialect_name)
    return Plan(
        dialect=chosen,
        sides=tuple(sides),
        objects=default_objects(chosen, sides),
        session=_session(chosen.model),
        phases=phases_for(catalogue(chosen.model)),
    )


def run_mutant(service: type[Service], plan: Plan | None = None) -> RunResult:
    """Judge one service, on the virtual clock."""
    chosen = plan or plan_for()
    trace = run_virtual(chosen, service)
    recording = Recording.of(trace, dialect_name=chosen.dialect.name, sides=chosen.sides)
    return judge(recording, subject={"backend": f"virtual {service.__name__}"})


def trial(mutant: Mutant, result: RunResult) -> Mapping[str, set[str]]:
    """What went wrong in a mutant's trial: ``missed`` and ``wrongly`` blamed requirements."""
    blamed = {
        r.requirement.id
        for r in result.results
        if r.verdict in (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)
    }
    return {
        "missed": {mutant.kills, *mutant.also} - blamed,
        "wrongly": blamed - {mutant.kills, *mutant.also},
    }
