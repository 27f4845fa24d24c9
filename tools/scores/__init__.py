"""Try generated wrong hands in runs of each kind, and write ``conformance/scores.json``.

``python -m tools.scores`` does it again after the requirements, the checks, the stimuli or the
generator have changed. The same seed gives the same hands and the same file. Each hand is examined
by the oracle once, and judged in every kind of run, so that the kinds are compared by the same
hands; the thorough run, which takes ten times as long, has the first ones of them only.
"""

from __future__ import annotations

import json
import multiprocessing
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.faults.generated import dialects, parse, sample
from dexkit.conformance.faults.generated.campaign import Trial, graded, judged
from dexkit.conformance.faults.generated.oracle import Severity
from dexkit.conformance.hands import under_test
from dexkit.conformance.requirements import catalogue
from dexkit.conformance.scores import FORMAT, Entry, Setting, catalogue_digest
from dexkit.conformance.selection import RunKind
from dexkit.conformance.stimuli import Plan, phases_for
from dexkit.errors import UsageError
from dexkit.hand import Side, Subject
from dexkit.models import BUILT_IN

__all__ = [
    "SEED",
    "Counts",
    "Task",
    "as_text",
    "counts_of",
    "entries_of",
    "is_current",
    "scored_models",
    "tasks",
]

SEED = 1
Counts = Mapping[tuple[RunKind, Setting], int]
"""How many hands are tried, by kind and setting of their runs."""
_NOT_OURS = frozenset({"shutdown", "service-restart"})
"""Phases that there are only where the kit has started the service."""


def scored_models() -> tuple[str, ...]:
    """Names of the models whose runs have scores: those of dexkit itself."""
    return tuple(m.name for m in BUILT_IN)


def counts_of(model_name: str) -> Counts:
    """How many hands are generated and tried, as the model's profile says.

    ``--hands`` tries fewer; the file says how many each entry has.
    """
    number = under_test(model_name).scored_hands
    found = {
        (RunKind.QUICK, Setting.WHOLE): number.quick,
        (RunKind.QUICK, Setting.EXTERNAL): number.external,
        (RunKind.DEFAULT, Setting.WHOLE): number.default,
        (RunKind.DEFAULT, Setting.EXTERNAL): number.external,
        (RunKind.THOROUGH, Setting.WHOLE): number.thorough,
    }
    return {key: n for key, n in found.items() if n}


@dataclass(frozen=True)
class Task:
    """One kind and setting of runs of a model, and how many hands are tried in them."""

    model: str
    run: RunKind
    setting: Setting
    hands: int

    def plan(self, dialect: str, sides: Sequence[Subject]) -> Plan[Subject]:
        """The plan of such a run."""
        plan = plan_for(dialect, sides=sides, run=self.run)
        if self.setting is Setting.EXTERNAL:
            return replace(plan, objects={}, phases=plan.phases - _NOT_OURS)
        return plan


def tasks(model_name: str, hands: Counts | None = None, *, most: int | None = None) -> list[Task]:
    """The trials of a model.

    :param hands: how many; None for those of :func:`counts_of`.
    :param most: not more hands than that in any kind of run.
    """
    counts = counts_of(model_name) if hands is None else hands
    return [
        Task(model_name, run, setting, n if most is None else min(n, most))
        for (run, setting), n in counts.items()
    ]


def _try(name: str, chosen: Sequence[Task]) -> list[Trial]:
    """Examine a hand, and judge it in the run of each task."""
    hand = parse(name)
    service = hand.service()
    trial, _ = graded(hand, service, SEED)
    if not trial.counts:
        return [trial for _ in chosen]
    plans = [task.plan(hand.dialect.name, hand.sides) for task in chosen]
    return [judged(trial, service, p, t.run) for t, p in zip(chosen, plans, strict=True)]


def _fewer(task: Task, dialect: str) -> dict[str, int]:
    """On how many sides of a good hand a requirement is judged, where it is not both."""
    # rounds do not change what can be judged
    plan = replace(task.plan(dialect, tuple(Side)), rounds=1)
    wanted = task.run.requirements(catalogue(task.model))
    results = run_mutant(under_test(task.model).reference.load(), plan, wanted).results
    found = Counter(r.requirement.id for r in results if r.verdict.judged)
    return {r.id: found[r.id] for r in wanted if found[r.id] != len(Side)}


def _entry(task: Task, trials: Sequence[Trial], fewer: Mapping[str, Mapping[str, int]]) -> Entry:
    by_grade = {
        grade: [t for t in trials if t.severity == grade.value]
        for grade in (Severity.BREAKING, Severity.LESSER, Severity.EQUIVALENT)
    }
    requirements = task.run.requirements(catalogue(task.model))
    plan = plan_for(next(iter(fewer)), run=task.run)
    return Entry(
        model=task.model,
        run=str(task.run),
        setting=str(task.setting),
        seed=SEED,
        hands=len(trials),
        equivalent=len(by_grade[Severity.EQUIVALENT]),
        must_breaking=tuple(t.caught_by for t in by_grade[Severity.BREAKING]),
        lesser=tuple(t.caught_by for t in by_grade[Severity.LESSER]),
        catalogue=catalogue_digest(task.model),
        rounds=plan.rounds,
        phases=plan.phases,
        requirements=tuple(r.id for r in requirements),
        fewer=fewer,
    )


def entries_of(
    model_name: str,
    *,
    hands: Counts | None = None,
    most: int | None = None,
    keep: Path | None = None,
    jobs: int | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> list[Entry]:
    """Try the hands of a model.

    :param hands: how many, and ``most``: see :func:`tasks`.
    :param keep: each trial is added to this file when it is done, and those that are there are
        not done again. None for none.
    :param jobs: processes; one per processor by default.
    :param report: called with the name of each hand that is done.
    """
    every = tasks(model_name, hands, most=most)
    spoken = dialects(model_name)
    names = [h.name for h in sample(max(t.hands for t in every), SEED, spoken)]
    wanted = {(task, name) for task in every for name in names[: task.hands]}
    found = {key: trial for key, trial in _kept(keep, every).items() if key in wanted}
    left = {n: [t for t in every if (t, n) in wanted and (t, n) not in found] for n in names}
    todo = [(name, chosen) for name, chosen in left.items() if chosen]
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        tried = pool.map(_try, [name for name, _ in todo], [chosen for _, chosen in todo])
        for (name, chosen), done in zip(todo, tried, strict=True):
            report(name)
            new = {(task, name): trial for task, trial in zip(chosen, done, strict=True)}
            _keep(keep, new)
            found |= new
        dialect_names = [d.name for d in spoken]
        pairs = [(task, name) for task in every for name in dialect_names]
        counts = pool.map(_fewer, [t for t, _ in pairs], [name for _, name in pairs])
        fewer = dict(zip(pairs, counts, strict=True))
    return [
        _entry(
            task,
            [found[task, name] for name in names[: task.hands]],
            {name: fewer[task, name] for name in dialect_names},
        )
        for task in every
    ]


def is_current(entry: Entry) -> bool:
    """Whether such a run still has the requirements, their limits and the phases of the trial."""
    run = RunKind(entry.run)
    plan = plan_for(next(iter(entry.fewer)), run=run)
    return (
        entry.catalogue == catalogue_digest(entry.model)
        and (entry.phases, entry.rounds) == (plan.phases, plan.rounds)
        and entry.requirements == tuple(r.id for r in run.requirements(catalogue(entry.model)))
    )


def _about(task: Task) -> dict[str, Any]:
    """What a trial of the task depends on, as plain data."""
    return {
        "run": str(task.run),
        "setting": str(task.setting),
        "catalogue": catalogue_digest(task.model),
        "phases": sorted(phases_for(task.run.requirements(catalogue(task.model)))),
        "seed": SEED,
    }


def _keep(file: Path | None, trials: Mapping[tuple[Task, str], Trial]) -> None:
    """Add trials to a file, a line of JSON each."""
    if file is None:
        return
    with file.open("a", encoding="utf-8") as out:
        for (task, _), trial in trials.items():
            out.write(json.dumps({"about": _about(task), "trial": asdict(trial)}) + "\n")


def _kept(file: Path | None, every: Sequence[Task]) -> dict[tuple[Task, str], Trial]:
    """The trials of the tasks that a file has; a line that was cut off is none.

    :raises UsageError: it is no such file.
    """
    if file is None or not file.exists():
        return {}
    found: dict[tuple[Task, str], Trial] = {}
    wanted = {t: _about(t) for t in every}
    lines = file.read_text(encoding="utf-8").split("\n")[:-1]
    for line in lines:
        try:
            values = json.loads(line)
            about, trial = values["about"], Trial.from_dict(values["trial"])
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UsageError(f"{file} has a line that is no trial of a hand") from error
        found |= {(t, trial.name): trial for t in every if wanted[t] == about}
    return found


def as_text(entries: Sequence[Entry]) -> str:
    """The file's content."""
    about = "written by python -m tools.scores; see docs/mutants.md"
    document = {"format": FORMAT, "about": about, "scores": [e.as_dict() for e in entries]}
    return json.dumps(document, indent=1) + "\n"
