"""Run an audit: find the episodes, judge them, write the tables and the summary page."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from msgspec import structs

from dexkit.conformance.audit.cleaning import EPISODES, cleaning_commands, episodes_listing
from dexkit.conformance.audit.examine import Task, examine, settings_key
from dexkit.conformance.audit.journal import Entry, Journal
from dexkit.conformance.audit.records import EpisodeRecord, State
from dexkit.conformance.audit.result_tables import write_tables
from dexkit.conformance.audit.summary_page import Summary, render
from dexkit.conformance.audit.units import Form, Unit, find, together
from dexkit.conformance.audit.workers import Pool, WorkerLost
from dexkit.conformance.dataset.across import across
from dexkit.conformance.dataset.findings import Finding, Judgement, Use, use_of
from dexkit.conformance.dataset.whole_set import WholeSet
from dexkit.conformance.kit.results import Overall, Verdict
from dexkit.documents import write_file
from dexkit.redaction import redact

__all__ = ["FAIL_ON", "Audit", "AuditProgress", "Limits", "Progress", "Runner", "in_this_process"]

FAIL_ON = ("never", "fail", "unusable", "warn")
"""Findings that make the exit code non-zero; each level includes those before it."""

Runner = Callable[
    [Iterable[Task], object], "Iterator[tuple[Task, list[EpisodeRecord] | WorkerLost]]"
]
"""Examines episodes until a stop request is true: in processes, or on a cluster."""


@dataclass(frozen=True)
class Limits:
    """Limits for one task: a recording, or some episodes of a dataset.

    :param memory: bytes of the process that examines it.
    :param max_size: bytes of an object that are copied; larger ones are read by ranges.
    """

    seconds: float = 600.0
    memory: int = 2**32
    max_size: int = 2**33

    def pool(self, jobs: int | None) -> Runner:
        """A runner in processes with these limits."""
        return Pool(examine, jobs=jobs, seconds=self.seconds, memory=self.memory).run


def in_this_process(
    tasks: Iterable[Task], stop: object
) -> Iterator[tuple[Task, list[EpisodeRecord]]]:
    """A runner without other processes, and without limits."""
    for task in tasks:
        if stop:
            return
        yield task, examine(task)


@dataclass
class AuditProgress:
    """Progress and results of an audit.

    :param total: episodes; ``done`` of them have a record, ``reused`` from an audit before.
    :param problems: locations that cannot be looked into.
    :param uses: how many are to be kept, reviewed and dropped; ``sets`` have something to review.
    :param failing: recordings of hands that do not meet a MUST; ``warned``, a SHOULD.
    :param commands: what makes the cleaned sets: caption and command line.
    :param seconds: since it began; ``examined_s`` of recordings were judged in them.
    """

    total: int = 0
    done: int = 0
    reused: int = 0
    problems: int = 0
    uses: Counter[str] = field(default_factory=Counter)
    sets: int = 0
    failing: int = 0
    unusable: int = 0
    warned: int = 0
    recorded_s: float = 0.0
    examined_s: float = 0.0
    examined_bytes: int = 0
    seconds: float = 0.0
    remaining_bytes: int = 0
    stopped: bool = False
    files: list[Path] = field(default_factory=list)
    commands: list[tuple[str, str]] = field(default_factory=list)

    def count(self, record: EpisodeRecord, *, reused: bool = False) -> None:
        """Count an episode that is done."""
        self.done += 1
        self.reused += reused
        self.count_verdict(record)
        seconds = record.facts.get("duration_s") or 0.0
        self.recorded_s += seconds
        if not reused:
            self.examined_s += seconds
            self.examined_bytes += record.size
            self.remaining_bytes -= record.size

    def count_verdict(self, record: EpisodeRecord) -> None:
        """Count what an episode, or a set, was found to be."""
        if record.is_set:
            self.sets += record.use != Use.KEEP
            return
        self.uses[record.use] += bool(record.use)
        self.failing += record.overall == Overall.FAIL
        self.unusable += record.exit_code == 2
        self.warned += any(f.verdict is Verdict.WARN for f in record.findings)

    def forget_verdicts(self) -> None:
        """Count them anew: a comparison of episodes may have changed them."""
        self.uses.clear()
        self.failing = self.unusable = self.warned = self.sets = 0

    @property
    def remaining_s(self) -> float | None:
        """Seconds until the end, by bytes; None while that is unknown."""
        if not self.examined_bytes or not self.seconds:
            return None
        return self.remaining_bytes * self.seconds / self.examined_bytes

    def exit_code(self, fail_on: str = "unusable") -> int:
        """0 if all is well, 1 if an episode is to be dropped or a MUST of a hand is not met, 2 if
        one cannot be used.

        :param fail_on: one of :data:`FAIL_ON`.
        """
        level = FAIL_ON.index(fail_on)
        if not self.done:
            return 2
        if level >= 1 and (self.failing or self.uses[Use.DROP]):
            return 1
        if level >= 2 and self.unusable:
            return 2
        remarkable = self.warned or self.uses[Use.REVIEW] or self.sets
        return 1 if level >= 3 and remarkable else 0


Progress = Callable[[AuditProgress], None]
"""Is called after each task with how far the audit is; it must not change what it gets."""


class Audit:
    """An audit of episodes.

    :param locations: files, folders and URLs.
    :param folder: where journal, tables and page are kept; it is created.
    :param parquet: whether the tables are Parquet; None where pyarrow decides.
    :param cameras: whether pictures are looked at.
    :param working_folder: what relative paths are relative to; None for the process' own.
    :raises UsageError: a URL of a kind that is not installed; another audit is running there.
    """

    def __init__(
        self,
        locations: Sequence[str],
        folder: Path,
        *,
        limits: Limits = Limits(),
        parquet: bool | None = None,
        cameras: bool = True,
        working_folder: Path | None = None,
    ) -> None:
        self.folder = folder
        self.locations = tuple(locations)
        self._working_folder = working_folder
        self._limits, self._parquet, self._cameras = limits, parquet, cameras
        self._before: dict[str, Entry] = {}  # of changed files, which may be the same inside
        self._sets: dict[str, WholeSet] = {}

    def run(
        self, runner: Runner, stop: object = None, progress: Progress | None = None
    ) -> AuditProgress:
        """Examine new and changed episodes, and write tables and page, also after a stop.

        :param stop: ends it early when it becomes true.
        :raises OutputError: something cannot be written.
        """
        begin = time.monotonic()
        outcome = AuditProgress()
        units: dict[str, Unit] = {}
        problems: dict[str, EpisodeRecord] = {}
        for location in self.locations:
            for found in find(location, self._working_folder):
                if isinstance(found, Unit):
                    units.setdefault(found.name, found)
                elif isinstance(found, WholeSet):
                    self._sets[found.name] = found
                else:
                    problems[found.name] = found
        self.folder.mkdir(parents=True, exist_ok=True)
        with Journal(self.folder / "journal.jsonl") as journal:
            names = sorted({*units, *problems})
            outcome.total, outcome.problems = len(names), len(problems)
            for record in problems.values():
                journal.add(record)
                outcome.count(record)
            tasks = self._tasks(journal, units, outcome)
            outcome.remaining_bytes = sum(task.size for task in tasks)
            for record in self._examined(runner, journal, tasks, stop):
                outcome.count(record)
                outcome.seconds = time.monotonic() - begin
                if progress is not None:
                    progress(outcome)
            outcome.stopped = outcome.done < outcome.total
            self._write(journal, names, outcome)
            outcome.seconds = time.monotonic() - begin
        return outcome

    def _tasks(
        self, journal: Journal, units: dict[str, Unit], outcome: AuditProgress
    ) -> list[Task]:
        """The episodes to be examined, largest first; counts those that need not be."""
        settings = settings_key(self._cameras)
        changed, known = [], {}
        for name, unit in units.items():
            entry = journal.entries.get(name)
            if entry is not None and entry.settings == settings and entry.state.final:
                if entry.tag and (entry.size, entry.tag) == (unit.size, unit.tag):
                    outcome.count(journal.read(entry), reused=True)
                    continue
                known[name], self._before[name] = entry.sha256, entry
            journal.entries.pop(name, None)  # whatever it says, it may no longer be true
            changed.append(unit)
        tasks = []
        for some in together(changed):
            sha256 = known.get(some[0].name, "") if some[0].form is Form.RECORDING else ""
            tasks.append(Task(some, sha256, self._limits.max_size, self._cameras))
        return sorted(tasks, key=lambda t: (-t.size, t.units[0].name))

    def _examined(
        self, runner: Runner, journal: Journal, tasks: Sequence[Task], stop: object
    ) -> Iterator[EpisodeRecord]:
        """The records of tasks as they are done. Where a process was lost with several episodes,
        each is done again by itself: the others are not to blame.
        """
        again: list[Task] = []
        for task, result in runner(tasks, stop):
            if isinstance(result, WorkerLost) and len(task.units) > 1:
                again += [replace(task, units=(unit,)) for unit in task.units]
            else:
                yield from self._records(journal, task, result)
        if again:
            for task, result in runner(again, stop):
                yield from self._records(journal, task, result)

    def _records(
        self, journal: Journal, task: Task, result: list[EpisodeRecord] | WorkerLost
    ) -> Iterator[EpisodeRecord]:
        if isinstance(result, WorkerLost):
            state = State.TOO_LARGE if "longer" in result else State.FAILED
            records = [
                EpisodeRecord(
                    unit.name,
                    unit.size,
                    unit.tag,
                    state,
                    error=redact(result, unit.place),
                    source=unit.source,
                    episode=unit.episode,
                )
                for unit in task.units
            ]
        else:
            records = result
        for record in records:
            if task.known and record.sha256 == task.known:
                before = journal.read(self._before[record.name])
                record = structs.replace(before, size=record.size, tag=record.tag)
            journal.add(record)
            yield record

    def _write(self, journal: Journal, names: Sequence[str], outcome: AuditProgress) -> None:
        compared = self._compared(journal, names)

        def records() -> Iterator[EpisodeRecord]:
            for record in journal.records(names):
                yield record.with_findings(compared.get(record.name, ()))
            for name, whole in sorted(self._sets.items()):
                judgement = Judgement(findings=list(compared.get(name, ())))
                judgement.use = use_of(judgement.findings)
                yield EpisodeRecord(
                    name,
                    state=State.JUDGED,
                    source=name,
                    form=whole.form,
                    is_set=True,
                    judgement=judgement,
                    exit_code=0,
                )

        summary = Summary()
        outcome.forget_verdicts()
        for record in records():
            outcome.count_verdict(record)
            summary.add(record)
        outcome.files = write_tables(self.folder, records, parquet=self._parquet)
        listing = self.folder / EPISODES
        write_file(listing, episodes_listing(records(), self._working_folder))
        page = self.folder / "summary.html"
        locations = [redact(location, location) for location in self.locations]
        commands = cleaning_commands(records(), listing)
        write_file(
            page,
            render(summary, locations=locations, left=len(names) - outcome.done, commands=commands),
        )
        outcome.files += [listing, page]
        outcome.commands = commands

    def _compared(self, journal: Journal, names: Sequence[str]) -> Mapping[str, Sequence[Finding]]:
        """What a comparison of the episodes with each other, and with their metadata, finds."""
        judged: dict[str, dict[str, Judgement]] = {}
        for record in journal.records(names):
            if record.judgement is not None:
                light = structs.replace(record.judgement, curves=[], shots=[])
                judged.setdefault(record.source, {})[record.name] = light
        found: dict[str, list[Finding]] = {}
        for source, judgements in judged.items():
            for name, findings in across(judgements, self._sets.get(source)).items():
                found.setdefault(name, []).extend(findings)
        return found
