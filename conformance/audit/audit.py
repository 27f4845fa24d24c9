"""Run an audit: find the files, judge them, write the tables and the summary page."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from dexkit.conformance.audit.examine import Task, examine, settings_key
from dexkit.conformance.audit.file_records import FileRecord, State
from dexkit.conformance.audit.journal import Entry, Journal
from dexkit.conformance.audit.result_tables import write_tables
from dexkit.conformance.audit.sessions import SessionFile, find
from dexkit.conformance.audit.summary_page import Summary, render
from dexkit.conformance.audit.workers import Pool, WorkerLost
from dexkit.conformance.kit.results import Verdict
from dexkit.documents import write_file
from dexkit.redaction import redact

__all__ = ["FAIL_ON", "Audit", "AuditProgress", "Limits", "Progress", "Runner", "in_this_process"]

FAIL_ON = ("never", "fail", "unusable", "warn")
"""Findings that make the exit code non-zero; each level includes those before it."""

Runner = Callable[[Iterable[Task], object], "Iterator[tuple[Task, FileRecord | WorkerLost]]"]
"""Examines files until a stop request is true: in processes, or on a cluster."""


@dataclass(frozen=True)
class Limits:
    """Limits for one file.

    :param memory: bytes of the process that examines it.
    :param max_size: bytes of an object that are copied; larger ones are read by ranges.
    """

    seconds: float = 600.0
    memory: int = 2**32
    max_size: int = 2**33

    def pool(self, jobs: int | None) -> Runner:
        """A runner in processes with these limits."""
        return Pool(examine, jobs=jobs, seconds=self.seconds, memory=self.memory).run


def in_this_process(tasks: Iterable[Task], stop: object) -> Iterator[tuple[Task, FileRecord]]:
    """A runner without other processes, and without limits."""
    for task in tasks:
        if stop:
            return
        yield task, examine(task)


@dataclass
class AuditProgress:
    """Progress and results of an audit.

    :param total: files; ``done`` of them have a record, ``reused`` from an audit before.
    :param problems: locations that cannot be looked into.
    :param seconds: since it began; ``examined_s`` of recordings were judged in them.
    """

    total: int = 0
    done: int = 0
    reused: int = 0
    problems: int = 0
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

    def count(self, record: FileRecord, *, reused: bool = False) -> None:
        """Count a file."""
        self.done += 1
        self.reused += reused
        self.failing += record.failed
        self.unusable += record.exit_code == 2
        self.warned += any(f.verdict is Verdict.WARN for f in record.findings)
        seconds = record.facts.get("duration_s") or 0.0
        self.recorded_s += seconds
        if not reused:
            self.examined_s += seconds
            self.examined_bytes += record.size
            self.remaining_bytes -= record.size

    @property
    def remaining_s(self) -> float | None:
        """Seconds until the end, by bytes; None while that is unknown."""
        if not self.examined_bytes or not self.seconds:
            return None
        return self.remaining_bytes * self.seconds / self.examined_bytes

    def exit_code(self, fail_on: str = "unusable") -> int:
        """0 if all is well, 1 if a requirement is not met, 2 if a file cannot be used.

        :param fail_on: one of :data:`FAIL_ON`.
        """
        level = FAIL_ON.index(fail_on)
        if not self.done:
            return 2
        if level >= 1 and self.failing:
            return 1
        if level >= 2 and self.unusable:
            return 2
        return 1 if level >= 3 and self.warned else 0


Progress = Callable[[AuditProgress], None]
"""Is called after each file with how far the audit is; it must not change what it gets."""


class Audit:
    """An audit of sessions.

    :param locations: files, folders and URLs.
    :param folder: where journal, tables and page are kept; it is created.
    :param parquet: whether the tables are Parquet; None where pyarrow decides.
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
        working_folder: Path | None = None,
    ) -> None:
        self.folder = folder
        self.locations = tuple(locations)
        self._working_folder = working_folder
        self._limits, self._parquet = limits, parquet
        self._before: dict[str, Entry] = {}  # of changed files, which may be the same inside

    def run(
        self, runner: Runner, stop: object = None, progress: Progress | None = None
    ) -> AuditProgress:
        """Examine new and changed files, and write tables and page, also after a stop.

        :param stop: ends it early when it becomes true.
        :raises OutputError: something cannot be written.
        """
        begin = time.monotonic()
        outcome = AuditProgress()
        sessions: dict[str, SessionFile] = {}
        problems: dict[str, FileRecord] = {}
        for location in self.locations:
            for found in find(location, self._working_folder):
                if isinstance(found, SessionFile):
                    sessions.setdefault(found.name, found)
                else:
                    problems[found.name] = found
        self.folder.mkdir(parents=True, exist_ok=True)
        with Journal(self.folder / "journal.jsonl") as journal:
            names = sorted({*sessions, *problems})
            outcome.total, outcome.problems = len(names), len(problems)
            for record in problems.values():
                journal.add(record)
                outcome.count(record)
            tasks = self._tasks(journal, sessions, outcome)
            outcome.remaining_bytes = sum(task.session.size for task in tasks)
            for task, result in runner(tasks, stop):
                record = self._record(journal, task, result)
                outcome.count(record)
                outcome.seconds = time.monotonic() - begin
                if progress is not None:
                    progress(outcome)
            outcome.stopped = outcome.done < outcome.total
            outcome.seconds = time.monotonic() - begin
            self._write(journal, names, outcome)
        return outcome

    def _tasks(
        self, journal: Journal, sessions: dict[str, SessionFile], outcome: AuditProgress
    ) -> list[Task]:
        """The files to be examined, largest first; counts those that need not be."""
        settings = settings_key()
        tasks = []
        for name, session in sessions.items():
            entry = journal.entries.get(name)
            known = ""
            if entry is not None and entry.settings == settings and entry.state.final:
                if entry.tag and (entry.size, entry.tag) == (session.size, session.tag):
                    outcome.count(journal.read(entry), reused=True)
                    continue
                known, self._before[name] = entry.sha256, entry
            journal.entries.pop(name, None)  # whatever it says, it may no longer be true
            tasks.append(Task(session, known, self._limits.max_size))
        return sorted(tasks, key=lambda t: (-t.session.size, t.session.name))

    def _record(self, journal: Journal, task: Task, result: FileRecord | WorkerLost) -> FileRecord:
        session = task.session
        if isinstance(result, WorkerLost):
            state = State.TOO_LARGE if "longer" in result else State.FAILED
            error = redact(result, session.place)
            record = FileRecord(session.name, session.size, session.tag, state, error=error)
        elif task.known and result.sha256 == task.known:
            record = msgspec.structs.replace(
                journal.read(self._before[session.name]), size=session.size, tag=session.tag
            )
        else:
            record = result
        journal.add(record)
        return record

    def _write(self, journal: Journal, names: Sequence[str], outcome: AuditProgress) -> None:
        summary = Summary()
        for record in journal.records(names):
            summary.add(record)
        outcome.files = write_tables(
            self.folder, lambda: journal.records(names), parquet=self._parquet
        )
        page = self.folder / "summary.html"
        locations = [redact(location, location) for location in self.locations]
        write_file(page, render(summary, locations=locations, left=len(names) - outcome.done))
        outcome.files.append(page)
