"""Try generated hands on the conformance checks and score the checks by them.

Each wrong hand is examined by the oracle first. What it finds equivalent to the reference is listed
and not counted. A must-breaking hand is caught if it fails a MUST, a lesser one if anything fails
or warns, of an area that its faults declare: anything else is a find for the wrong reason. A good
hand must not be blamed for anything.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from dexkit.conformance.faults.generated import Generated, parse
from dexkit.conformance.faults.generated.oracle import Opinion, Severity, examine, shortest
from dexkit.conformance.faults.generated.rig import Faulty
from dexkit.conformance.faults.matrix import in_processes
from dexkit.conformance.faults.outsiders import blame
from dexkit.conformance.faults.trials import plan_for, run_mutant
from dexkit.conformance.kit.catch_rates import wilson
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.selection import RunKind
from dexkit.conformance.stimuli import Plan
from dexkit.console import Console
from dexkit.documents import parse_json, read_text, write_file
from dexkit.errors import UsageError
from dexkit.hand import Subject
from dexkit.records import to_record

__all__ = ["Campaign", "Trial", "graded", "judged", "try_generated"]

GOOD = "good"


@dataclass(frozen=True)
class Trial:
    """Result of the trial of one hand.

    :param severity: ``must-breaking``, ``lesser``, ``equivalent``, or ``good``.
    :param in_kit: the severity of what shows under the kit's own stimulus alone.
    :param effect: what an observer can tell, gravest first.
    :param shown_by: the shortest stimulus that shows it; of survivors.
    :param permitted: ids of requirements that may warn of a good hand: what it leaves out.
    :param failed: ids of MUSTs that fail, ``warned`` of other requirements that fail or warn, and
        ``errors`` of those that could not be judged for a fault of the kit.
    """

    name: str
    kind: str
    summary: str
    severity: str
    in_kit: str = ""
    effect: str = ""
    shown_by: str = ""
    areas: tuple[str, ...] = ()
    permitted: tuple[str, ...] = ()
    failed: tuple[str, ...] = ()
    warned: tuple[str, ...] = ()
    errors: tuple[str, ...] = ()

    @property
    def counts(self) -> bool:
        """Whether it is part of the score."""
        return self.severity != Severity.EQUIVALENT.value

    @property
    def _finds(self) -> tuple[str, ...]:
        if self.severity == Severity.BREAKING.value:
            return self.failed
        return self.failed + self.warned

    @property
    def caught_by(self) -> frozenset[str]:
        """Ids of the requirements that found a wrong hand for a right reason."""
        return frozenset(r for r in self._finds if area_of(r) in self.areas)

    @property
    def caught(self) -> bool:
        """Whether the checks were right about it, for a right reason."""
        if self.severity == GOOD:
            return not (self.failed or self.blamed or self.errors)
        return bool(self.caught_by)

    @property
    def blamed(self) -> tuple[str, ...]:
        """Ids of the requirements that warn of a good hand, and may not."""
        return tuple(r for r in self.warned if r not in self.permitted)

    @property
    def wrong_reason(self) -> bool:
        """Whether a wrong hand was found for other reasons only."""
        return self.severity != GOOD and not self.caught and bool(self._finds)


def area_of(requirement: str) -> str:
    """The second word of a requirement's id: ``MOVE`` of ``DEX1-MOVE-02``."""
    return requirement.split("-")[-2]


def try_generated(
    hand: Generated, seed: int = 1, run: RunKind = RunKind.DEFAULT, *, outside: bool = False
) -> Trial:
    """Examine a hand, and judge it by a conformance run on the virtual clock.

    :param seed: of the oracle's random stimulus.
    :param run: which requirements are judged, and how much the hand is provoked.
    :param outside: judge it as a vendor's own service is: the kit cannot stop it, and knows of no
        object in the hand.
    """
    service = hand.service()
    trial, opinion = graded(hand, service, seed)
    if not trial.counts:
        return trial
    plan = plan_for(hand.dialect.name, sides=hand.sides, run=run)
    if outside:
        plan, service.can_be_stopped = replace(plan, objects={}), False
    trial = judged(trial, service, plan, run, hand.claims)
    if trial.caught or opinion is None:
        return trial
    return replace(trial, shown_by=shortest(hand, opinion, seed))


def graded(hand: Generated, service: type[Faulty], seed: int) -> tuple[Trial, Opinion | None]:
    """A hand's grade, not judged yet, and the oracle's opinion; None of a good hand.

    :param service: the hand's service.
    """
    trial = Trial(
        hand.name,
        hand.kind,
        hand.summary,
        GOOD,
        areas=tuple(sorted(hand.areas)),
        permitted=tuple(sorted(hand.permitted)),
    )
    if hand.good:
        return trial, None
    opinion = examine(service, hand.dialect, hand.sides, seed)
    trial = replace(trial, severity=opinion.severity.value, in_kit=opinion.in_kit.value)
    if trial.counts:
        worst = opinion.effects[0]
        where = f"{worst.stimulus}: {worst.stretch}, {worst.at:.2f} s"
        trial = replace(trial, effect=f"{worst.text} ({where})")
    return trial, opinion


def judged(
    trial: Trial,
    service: type[Faulty],
    plan: Plan[Subject],
    run: RunKind,
    claims: Claims | None = None,
) -> Trial:
    """The trial with what a run of that plan and kind finds."""
    wanted = run.requirements(catalogue(plan.dialect.model))
    failed, warned, errors = blame(run_mutant(service, plan, wanted, claims))
    return replace(trial, failed=failed, warned=warned, errors=errors)


def _work(name: str, seed: int, run: RunKind, outside: bool) -> Trial:
    return try_generated(parse(name), seed, run, outside=outside)


@dataclass
class Campaign:
    """The trials of many hands.

    :param file: where each is added as a line of JSON when it is done; those that are there
        already are not tried again. None for none.
    :param kind: of the conformance runs.
    :param outside: judge the hands as a vendor's own service is.
    """

    seed: int
    file: Path | None = None
    trials: list[Trial] = field(default_factory=list)
    kind: RunKind = RunKind.DEFAULT
    outside: bool = False

    @property
    def _run(self) -> str:
        return f"outside {self.kind}" if self.outside else str(self.kind)

    def run(
        self, hands: Sequence[Generated], stop: object = None, jobs: int | None = None
    ) -> Iterator[Trial]:
        """Try the hands in worker processes; yield each trial when it is done.

        :param stop: ends it early when it becomes true.
        :param jobs: processes; one per processor by default.
        :raises UsageError: the file holds something else than trials of this seed and kind.
        """
        done = self._done()
        for hand in hands:
            if hand.name in done:
                self.trials.append(done[hand.name])
                yield self.trials[-1]
        todo = [h for h in hands if h.name not in done]
        work = partial(_work, seed=self.seed, run=self.kind, outside=self.outside)
        for _, trial in in_processes(work, (h.name for h in todo), stop, jobs):
            yield self._add(trial)

    def _add(self, trial: Trial) -> Trial:
        self.trials.append(trial)
        if self.file is not None:
            with self.file.open("a", encoding="utf-8") as out:
                about = {"seed": self.seed, "run": self._run}
                out.write(json.dumps({**about, **asdict(trial)}) + "\n")
        return trial

    def _done(self) -> dict[str, Trial]:
        if self.file is None or not self.file.exists():
            return {}
        found = {}
        lines = read_text(self.file).splitlines()
        for number, line in enumerate(lines, 1):
            try:
                values = parse_json(line, f"{self.file}:{number}")
                seed = values.pop("seed")
                # files of earlier versions hold default runs only
                run = values.pop("run", str(RunKind.DEFAULT))
                trial = to_record(values, Trial, f"{self.file}:{number}")
            except (UsageError, TypeError, KeyError, AttributeError) as error:
                if number == len(lines):
                    break  # the line that was being written when the program was stopped
                raise UsageError(
                    f"{self.file}:{number}: no trial of generated hands",
                    hint="give a file of an earlier trial, or a new one",
                ) from error
            if seed != self.seed:
                raise UsageError(
                    f"{self.file} has the seed {seed}, not {self.seed}", hint="give its seed"
                )
            if run != self._run:
                raise UsageError(
                    f"{self.file} is of {run} runs, not {self._run} ones", hint="give another file"
                )
            found[trial.name] = trial
        return found

    # -- the score ---------------------------------------------------------------------------

    def trials_of(self, severity: str, kind: str | None = None) -> list[Trial]:
        """The trials of a severity, and of a class."""
        return [t for t in self.trials if t.severity == severity and kind in (None, t.kind)]

    @property
    def survivors(self) -> list[Trial]:
        """Wrong hands that were not caught for a right reason, the gravest first."""
        order = [Severity.BREAKING.value, Severity.LESSER.value]
        missed = [t for t in self.trials if t.severity in order and not t.caught]
        return sorted(missed, key=lambda t: (order.index(t.severity), t.kind, t.name))

    @property
    def blamed(self) -> list[Trial]:
        """Good hands that were blamed."""
        return [t for t in self.trials_of(GOOD) if not t.caught]

    @property
    def perfect(self) -> bool:
        """Whether no wrong hand survived and no good one was blamed."""
        return not self.survivors and not self.blamed

    def score(self, severity: str, kind: str | None = None) -> dict[str, object]:
        """Count, hits and confidence interval."""
        those = self.trials_of(severity, kind)
        hits = sum(t.caught for t in those)
        low, high = wilson(hits, len(those))
        return {
            "count": len(those),
            "caught": hits,
            "wrong_reason": sum(t.wrong_reason for t in those),
            "interval": [round(low, 4), round(high, 4)],
        }

    def as_dict(self) -> dict[str, object]:
        """The campaign as plain data."""
        kinds = list(dict.fromkeys(t.kind for t in self.trials if t.severity != GOOD))
        grades = [Severity.BREAKING.value, Severity.LESSER.value]
        return {
            "seed": self.seed,
            "run": self._run,
            "perfect": self.perfect,
            "score": {
                **{g: self.score(g) for g in grades},
                GOOD: {
                    **self.score(GOOD),
                    "failed": sum(bool(t.failed) for t in self.trials_of(GOOD)),
                    "warned": sum(bool(t.blamed) for t in self.trials_of(GOOD)),
                },
                "equivalent": len(self.trials_of(Severity.EQUIVALENT.value)),
            },
            "classes": {k: {g: self.score(g, k) for g in grades} for k in kinds},
            "hands": [
                {**asdict(t), "caught": t.caught, "wrong_reason": t.wrong_reason}
                for t in sorted(self.trials, key=lambda t: t.name)
            ],
        }

    def write_json(self, path: Path) -> None:
        """Write it to a file."""
        write_file(path, json.dumps(self.as_dict(), indent=2) + "\n")

    def print(self, console: Console, *, verbose: bool = False) -> None:
        """Print survivors, blamed good hands, and the score by class."""
        for t in self.survivors:
            reason = f"; blamed for {', '.join(t.failed + t.warned)}" if t.wrong_reason else ""
            console.print(f"[red]survived[/]  {escape(t.name)} ({t.severity})", soft_wrap=True)
            console.print(f"          {escape(t.effect)}{reason}", soft_wrap=True)
            console.print(f"          shown by: {escape(t.shown_by)}", soft_wrap=True)
        for t in self.blamed:
            ids = ", ".join(t.failed + t.blamed + t.errors)
            console.print(f"[red]blamed[/]    {escape(t.name)}: {ids}", soft_wrap=True)
        if verbose:
            for t in self.trials:
                state = "caught" if t.caught else "equivalent" if not t.counts else "not caught"
                console.print(f"{state:10} {escape(t.name)}: {escape(t.summary)}", soft_wrap=True)
        table = Table(box=None, pad_edge=False)
        for name in ("class", "must-breaking fail a MUST", "95 %", "lesser are seen", "95 %"):
            table.add_column(name, justify="left" if name == "class" else "right")
        kinds = dict.fromkeys(t.kind for t in self.trials if t.severity != GOOD)
        for kind in (*kinds, None):
            cells = []
            for grade in (Severity.BREAKING.value, Severity.LESSER.value):
                those = self.trials_of(grade, kind)
                hits = sum(t.caught for t in those)
                low, high = wilson(hits, len(those))
                cells += [f"{hits}/{len(those)}", f"{100 * low:.0f} to {100 * high:.0f} %"]
            table.add_row(kind or "all", *(cells if self.survivors or kinds else []))
        if kinds:
            console.print(table)
            count = len(self.trials_of(Severity.EQUIVALENT.value))
            console.print(
                f"{count} hands cannot be distinguished from the reference, and are not counted"
            )
        if good := self.trials_of(GOOD):
            console.print(
                f"{len(good)} good hands: {sum(bool(t.failed) for t in good)} fail a MUST, "
                f"{sum(bool(t.blamed) for t in good)} are warned of what they do not lack",
                style="red" if self.blamed else "green",
            )
