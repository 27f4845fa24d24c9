"""All wrong hands against all requirements: who is caught, by what, and what nobody proves.

``dexkit mutants`` prints it, the tests demand that it is perfect.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from dexkit.conformance import mutants as dds
from dexkit.conformance.mutants import robot, shared
from dexkit.conformance.requirements import Level, Requirement, catalogue, select
from dexkit.conformance.usb import mutants as usb
from dexkit.console import Console
from dexkit.documents import write_file
from dexkit.models import DEX3_1, model

__all__ = ["Outcome", "Score", "Trial", "chosen", "essential", "trials", "try_one"]


@dataclass(frozen=True)
class Trial:
    """One wrong hand to be tried.

    :param kills: the requirement that must catch it; ``also`` what cannot but fail with it.
    :param cost: seconds that it takes, roughly, in units of the shortest.
    """

    layer: str
    model: str
    name: str
    kills: str
    also: tuple[str, ...]
    summary: str
    cost: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """What a trial showed.

    :param missed: requirements that should have caught it and did not.
    :param wrongly: requirements that found fault with it and should not have.
    """

    trial: Trial
    missed: tuple[str, ...] = ()
    wrongly: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The wrong hand's name."""
        return self.trial.name

    @property
    def good(self) -> bool:
        """Whether it was caught, and for the right reason."""
        return not self.missed and not self.wrongly


def _cost(mutant: dds.Mutant) -> float:
    per_phase = 1 if model(mutant.model).dialects[0].is_gripper else 2
    return len(mutant.sides) * (1 if mutant.brief else 3) * per_phase


def trials() -> tuple[Trial, ...]:
    """Every wrong hand, on the topics and on USB, and every wrong robot."""
    found = [
        Trial(
            "dds",
            m.model,
            m.name,
            m.kills,
            m.also,
            m.summary,
            _cost(m),
        )
        for m in dds.mutants()
    ]
    return (
        *found,
        *(Trial("usb", DEX3_1.name, m.name, m.kills, m.also, m.summary, 0.5) for m in usb.MUTANTS),
        *(Trial("robot", m.model, m.name, m.kills, m.also, m.summary, 4.0) for m in robot.MUTANTS),
    )


def chosen(
    model: str | None = None, prefixes: Sequence[str] = ()
) -> tuple[tuple[Requirement, ...], tuple[Trial, ...]]:
    """The requirements of a model whose id begins so, and the wrong hands that prove them.

    :raises UsageError: a prefix matches nothing.
    """
    requirements = select(catalogue(model, None), prefixes=prefixes)
    wanted = {r.id for r in requirements}
    return requirements, tuple(t for t in trials() if t.kills in wanted)


def essential(given: Sequence[Trial]) -> tuple[Trial, ...]:
    """The cheapest wrong hand of each MUST."""
    musts = {r.id for r in catalogue(None, None) if r.level is Level.MUST}
    found: dict[str, Trial] = {}
    for trial in sorted(given, key=lambda t: t.cost):
        if trial.kills in musts:
            found.setdefault(trial.kills, trial)
    return tuple(found.values())


def try_one(trial: Trial, *, short: bool = False) -> Outcome:
    """Run a wrong hand on a virtual clock, and judge it by everything.

    :param short: go through no more phases than show it, where that is fair.
    """
    if trial.layer == "usb":
        wrong = next(m for m in usb.MUTANTS if (m.name, m.kills) == (trial.name, trial.kills))
        _, blamed = usb.try_mutant(wrong.device, catalogue(trial.model, "usb"))
        return _outcome(trial, blamed)
    if trial.layer == "robot":
        bad = next(m for m in robot.MUTANTS if (m.model, m.name) == (trial.model, trial.name))
        return _outcome(trial, bad.blamed(short=short))
    mutant = next(m for m in dds.mutants() if (m.model, m.name) == (trial.model, trial.name))
    plan = mutant.short_plan if short and mutant.name not in shared.DILUTED else mutant.plan
    found = dds.trial(mutant, dds.run_mutant(mutant.service, plan))
    return Outcome(trial, tuple(sorted(found["missed"])), tuple(sorted(found["wrongly"])))


def _outcome(trial: Trial, blamed: set[str]) -> Outcome:
    due = {trial.kills, *trial.also}
    return Outcome(trial, tuple(sorted(due - blamed)), tuple(sorted(blamed - due)))


def _ignore_interrupts() -> None:
    # Ctrl-C goes to every process of the terminal; the first one ends the others
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@dataclass
class Score:
    """The matrix: what every trial showed of the requirements."""

    requirements: Sequence[Requirement]
    outcomes: list[Outcome] = field(default_factory=list)

    def run(
        self, given: Sequence[Trial], stop: object = None, jobs: int | None = None
    ) -> Iterator[Outcome]:
        """Try them in processes of their own; yields each as it is done.

        :param stop: ends it early when it becomes true.
        :param jobs: processes; one a processor by default.
        """
        context = multiprocessing.get_context("spawn")
        ordered = sorted(given, key=lambda t: -t.cost)
        pool = ProcessPoolExecutor(jobs, context, _ignore_interrupts)
        try:
            waiting = {pool.submit(try_one, trial) for trial in ordered}
            while waiting and not stop:
                done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in done:
                    self.outcomes.append(future.result())
                    yield self.outcomes[-1]
        finally:
            # not as a context manager: that would run what is still waiting
            pool.shutdown(cancel_futures=True)

    def killers(self, requirement: Requirement) -> list[Outcome]:
        """The trials that prove a requirement."""
        return [
            o
            for o in self.outcomes
            if o.trial.kills == requirement.id and requirement.id not in o.missed
        ]

    @property
    def unproven(self) -> list[Requirement]:
        """Requirements that no wrong hand is caught by."""
        return [r for r in self.requirements if not self.killers(r)]

    @property
    def perfect(self) -> bool:
        """Whether every requirement is proven, and every wrong hand caught for its reason."""
        return not self.unproven and all(o.good for o in self.outcomes)

    def as_dict(self) -> dict[str, object]:
        """The matrix as plain data."""
        return {
            "perfect": self.perfect,
            "requirements": {
                r.id: {"level": str(r.level), "killed_by": [o.name for o in self.killers(r)]}
                for r in self.requirements
            },
            "mutants": [
                {
                    "name": o.name,
                    "layer": o.trial.layer,
                    "model": o.trial.model,
                    "kills": o.trial.kills,
                    "also": list(o.trial.also),
                    "summary": o.trial.summary,
                    "missed": list(o.missed),
                    "wrongly": list(o.wrongly),
                }
                for o in sorted(self.outcomes, key=lambda o: (o.trial.kills, o.name))
            ],
        }

    def write_json(self, path: Path) -> None:
        """Write it to a file."""
        write_file(path, json.dumps(self.as_dict(), indent=2) + "\n")

    def print(self, console: Console, *, verbose: bool = False) -> None:
        """The score by area, and whatever is not as it should be."""
        table = Table(box=None, pad_edge=False)
        for name in ("", "MUST", "SHOULD", "INFO", "wrong hands"):
            table.add_column(name, justify="left" if not name else "right")
        groups: dict[tuple[str, str], list[Requirement]] = {}
        for r in self.requirements:
            groups.setdefault((r.id.partition("-")[0], r.area), []).append(r)
        for (prefix, area), group in groups.items():
            ids = {r.id for r in group}
            cells = []
            for level in Level:
                those = [r for r in group if r.level is level]
                proven = sum(bool(self.killers(r)) for r in those)
                cells.append(f"{proven}/{len(those)}" if those else "")
            count = sum(o.trial.kills in ids for o in self.outcomes)
            table.add_row(f"{prefix} {area}", *cells, str(count))
        console.print(table)
        if verbose:
            for o in sorted(self.outcomes, key=lambda o: o.trial.kills):
                console.print(f"{o.trial.kills:14} {o.name}: {escape(o.trial.summary)}")
        for requirement in self.unproven:
            console.print(
                f"[red]unproven[/]  {requirement.id} ({requirement.level}): no wrong hand is "
                "caught by it"
            )
        for o in self.outcomes:
            if o.missed:
                console.print(f"[red]survived[/]  {o.name} was not caught by {', '.join(o.missed)}")
            if o.wrongly:
                console.print(
                    f"[red]stray[/]     {o.name} (of {o.trial.kills}) was also blamed for "
                    f"{', '.join(o.wrongly)}"
                )
        proven = len(self.requirements) - len(self.unproven)
        caught = sum(o.good for o in self.outcomes)
        console.print(
            f"{proven} of {len(self.requirements)} requirements proven; {caught} of "
            f"{len(self.outcomes)} wrong hands caught for the right reason",
            style="green" if self.perfect else "red",
            highlight=False,
        )
