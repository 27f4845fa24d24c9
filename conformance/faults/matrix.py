"""The matrix of all wrong hands and all requirements: which fault each requirement finds, and which
requirement no wrong hand proves.

``python -m dexkit.conformance.faults`` prints it; the tests require that it is complete.
"""

from __future__ import annotations

import json
import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from rich.markup import escape
from rich.table import Table

from dexkit.conformance.faults import Mutant, mutants
from dexkit.conformance.faults.trials import blamed, cost
from dexkit.conformance.kit.requirements import Level, Requirement, catalogue, select
from dexkit.console import Console
from dexkit.documents import write_file

__all__ = [
    "Score",
    "WrongHandResult",
    "chosen",
    "essential",
    "in_processes",
    "print_list",
    "try_one",
    "with_key",
]

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class WrongHandResult:
    """Result of the trial of a wrong hand.

    :param missed: requirements that should have failed or warned, and did not.
    :param wrongly: requirements that failed or warned, and should not have.
    """

    mutant: Mutant
    missed: tuple[str, ...] = ()
    wrongly: tuple[str, ...] = ()

    @classmethod
    def from_blame(cls, mutant: Mutant, blamed: set[str]) -> WrongHandResult:
        """Compare the requirements that failed or warned with the pinned ones."""
        due, may = {mutant.kills, *(mutant.pinned or ())}, mutant.pinned or blamed
        return cls(mutant, tuple(sorted(due - blamed)), tuple(sorted(blamed - may)))

    @property
    def name(self) -> str:
        """The wrong hand's name."""
        return self.mutant.name

    @property
    def good(self) -> bool:
        """Whether exactly the pinned requirements found the fault."""
        return not self.missed and not self.wrongly


def chosen(
    model: str | None = None, prefixes: Sequence[str] = ()
) -> tuple[tuple[Requirement, ...], tuple[Mutant, ...]]:
    """The requirements of a model whose id begins so, and the wrong hands that prove them.

    :raises UsageError: a prefix matches nothing.
    """
    requirements = select(catalogue(model, None), prefixes=prefixes)
    wanted = {r.id for r in requirements}
    return requirements, tuple(m for m in mutants() if m.kills in wanted)


def print_list(console: Console, given: Sequence[Mutant]) -> None:
    """Print wrong hands with their models, the requirements that must find them, and sides."""
    table = Table(box=None, header_style="bold", title_justify="left")
    for name in ("wrong hand", "model", "kills", "sides", "what it does wrong"):
        table.add_column(name, overflow="fold", no_wrap=name in ("model", "kills"))
    for m in given:
        sides = " and ".join(dict.fromkeys(str(s) for s in m.sides))
        spoken = f" ({m.dialect})" if m.dialect else ""
        table.add_row(m.name, m.model + spoken, m.kills, sides, escape(m.summary))
    console.print(table)
    console.print(f"{len(given)} wrong hands", highlight=False)


def essential(given: Sequence[Mutant]) -> tuple[Mutant, ...]:
    """The cheapest wrong hand of each MUST, if possible one that a short run shows."""
    musts = {r.id for r in catalogue(None, None) if r.level is Level.MUST}
    found: dict[str, Mutant] = {}
    for mutant in sorted(given, key=lambda m: (cost(m), m.whole)):
        if mutant.kills in musts:
            found.setdefault(mutant.kills, mutant)
    return tuple(found.values())


def try_one(mutant: Mutant, *, short: bool = False) -> WrongHandResult:
    """Run a wrong hand on a virtual clock, and judge it by every requirement.

    :param short: apply only the phases that show the fault, where that is fair.
    """
    return WrongHandResult.from_blame(mutant, blamed(mutant, short=short))


def with_key(key: tuple[str, str, str]) -> Mutant:
    """The wrong hand with that :attr:`~.Mutant.key`."""
    return next(m for m in mutants() if m.key == key)


def _blamed(key: tuple[str, str, str]) -> set[str]:
    """Run a trial in a worker process, which gets the key: mixed classes cannot be pickled."""
    return blamed(with_key(key))


def _ignore_interrupts() -> None:
    """Ignore Ctrl-C, which goes to every process of the terminal; the first ends the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def in_processes(
    work: Callable[[T], R], given: Iterable[T], stop: object = None, jobs: int | None = None
) -> Iterator[tuple[T, R]]:
    """Call a function in worker processes; yield each argument with its result when it is done.

    :param given: the arguments; the first ones are begun first.
    :param stop: ends it early when it becomes true.
    :param jobs: processes; one per processor by default.
    """
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _ignore_interrupts)
    try:
        waiting = {pool.submit(work, one): one for one in given}
        while waiting and not stop:
            for future in wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    finally:
        # not as a context manager, which would run what is waiting
        pool.shutdown(cancel_futures=True)


@dataclass
class Score:
    """The matrix: the outcome of every trial, by requirement."""

    requirements: Sequence[Requirement]
    outcomes: list[WrongHandResult] = field(default_factory=list)

    def run(
        self, given: Sequence[Mutant], stop: object = None, jobs: int | None = None
    ) -> Iterator[WrongHandResult]:
        """Run the trials in worker processes; yield each outcome when it is done.

        :param stop: ends it early when it becomes true.
        :param jobs: processes; one per processor by default.
        """
        by_key = {mutant.key: mutant for mutant in sorted(given, key=lambda m: -cost(m))}
        for key, found in in_processes(_blamed, by_key, stop, jobs):
            self.outcomes.append(WrongHandResult.from_blame(by_key[key], found))
            yield self.outcomes[-1]

    def killers(self, requirement: Requirement) -> list[WrongHandResult]:
        """The trials that prove a requirement."""
        return [
            o
            for o in self.outcomes
            if o.mutant.kills == requirement.id and requirement.id not in o.missed
        ]

    @property
    def unproven(self) -> list[Requirement]:
        """Requirements that no wrong hand proves."""
        return [r for r in self.requirements if not self.killers(r)]

    @property
    def perfect(self) -> bool:
        """Whether every requirement is proven, and every wrong hand found by its requirements."""
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
                    "layer": o.mutant.layer,
                    "model": o.mutant.model,
                    "kills": o.mutant.kills,
                    "also": sorted((o.mutant.pinned or frozenset()) - {o.mutant.kills}),
                    "summary": o.mutant.summary,
                    "missed": list(o.missed),
                    "wrongly": list(o.wrongly),
                }
                for o in sorted(self.outcomes, key=lambda o: (o.mutant.kills, o.name))
            ],
        }

    def write_json(self, path: Path) -> None:
        """Write it to a file."""
        write_file(path, json.dumps(self.as_dict(), indent=2) + "\n")

    def print(self, console: Console, *, verbose: bool = False) -> None:
        """Print the score by area, and all missed or extra failures."""
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
            count = sum(o.mutant.kills in ids for o in self.outcomes)
            table.add_row(f"{prefix} {area}", *cells, str(count))
        console.print(table)
        if verbose:
            for o in sorted(self.outcomes, key=lambda o: o.mutant.kills):
                console.print(f"{o.mutant.kills:14} {o.name}: {escape(o.mutant.summary)}")
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
                    f"[red]stray[/]     {o.name} (of {o.mutant.kills}) was also blamed for "
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
