"""Judge one file of an archive; whatever is wrong with it becomes its record."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from dexkit import __version__
from dexkit.conformance.audit.file_records import FileRecord, Finding, State
from dexkit.conformance.audit.sessions import SessionFile, opened, problem_of
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.results import Overall, RunResult, overall_of
from dexkit.conformance.kit.run_record import catalogue_digest, recorded_claims
from dexkit.errors import DexkitError
from dexkit.escaping import one_line
from dexkit.hand import Floats
from dexkit.redaction import redact
from dexkit.traces import Trace, open_trace
from dexkit.traces.container import OpenFile

__all__ = ["Task", "examine", "settings_key"]

_LABELS = ("robot", "operator", "task", "site")
"""Keys of a recording's metadata, in any of its records, by which an audit groups sessions."""
_SOME = 5  # of a file's warnings are kept
_TEXT = 500  # characters of each


@dataclass(frozen=True)
class Task:
    """A file to be examined.

    :param known: the SHA-256 that it had when it was examined the last time, or empty.
    :param max_size: bytes of an object that are copied; larger ones are read by ranges.
    """

    session: SessionFile
    known: str = ""
    max_size: int = 2**33


def settings_key() -> str:
    """Key of the settings; records are reused only if it is equal."""
    return ",".join([__version__, catalogue_digest(), *_LABELS])


def examine(task: Task) -> FileRecord:
    """Judge a file as ``dexkit check`` does. Raises nothing but what ends the process.

    :returns: the record; without findings, and with ``sha256`` equal to ``task.known``, if the
        file is the one that was examined before.
    """
    begin = time.process_time()
    session = task.session
    digest = ""
    try:
        with opened(session, task.max_size) as (path, open_file, digest):
            if digest != task.known:
                record = _judged(path, open_file, session.name)
            else:
                record = FileRecord(session.name, state=State.JUDGED)
    except (DexkitError, OSError, MemoryError) as error:
        record = problem_of(session.name, error, session.place)
        if isinstance(error, MemoryError):
            record.error, record.hint = "it needs more memory than it may use", "--memory"
    except Exception as error:  # of a storage, or a mistake of dexkit: a row, not an end
        record = problem_of(session.name, error, session.place)
        if digest:
            record.state = State.FAILED
            record.error = f"{_where()}: {record.error}"
            record.hint = "please report this, with the file if you can"
    record.size, record.tag, record.sha256 = session.size, session.tag, digest
    record.settings = settings_key()
    record.dexkit, record.catalogue = __version__, catalogue_digest()
    record.facts["cpu_s"] = round(time.process_time() - begin, 4)
    return record


def _where() -> str:
    """The innermost place of the exception that is being handled."""
    trace = sys.exc_info()[2]
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "?" if trace is None else f"{trace.tb_frame.f_code.co_name}:{trace.tb_lineno}"


def _judged(path: Path, open_file: OpenFile | None, name: str) -> FileRecord:
    facts: dict[str, Any] = {}
    try:
        trace = open_trace(path, open_file)
        facts = _facts_of_trace(trace)
        view = recording_of(trace, None, ())
        facts |= _facts_of_recording(view)
        result = judge(view, claims=recorded_claims(view.run))
        facts |= _facts_of_result(result)
    except DexkitError as error:
        record = problem_of(name, error)
        record.error = record.error.replace(str(path), name)
        record.facts = facts
        return record
    about = "robot" if view.layer == "robot" else "hand"
    damage = facts["damage"] = _some(trace.damage)
    facts["warnings"] = _some(trace.warnings)
    if not result.judged:
        state, error_text = State.NOT_JUDGED, "nothing was judged, which is not a pass"
    elif damage:
        state, error_text = State.JUDGED, f"damaged: {damage[0]}"
    else:
        open_must = result.overall is Overall.INCONCLUSIVE
        state, error_text = State.JUDGED, result.sentence() if open_must else ""
    return FileRecord(
        name,
        state=state,
        error=error_text,
        overall=str(result.overall),
        client=str(overall_of(result.client)) if result.client else "",
        exit_code=2 if error_text else result.exit_code(),
        facts=facts,
        findings=[
            *(Finding.of(r, about) for r in result.results),
            *(Finding.of(r, "client") for r in result.client),
        ],
    )


def _some(texts: Sequence[str]) -> list[str]:
    return [one_line(text, _TEXT) for text in texts[:_SOME]]


def _facts_of_trace(trace: Trace) -> dict[str, Any]:
    start = datetime.fromtimestamp(trace.first_ns / 1e9, timezone.utc)
    return {
        "recorded_at": start.isoformat(timespec="seconds") if trace.first_ns else "",
        "duration_s": round(trace.duration, 3),
        "messages": trace.message_count,
        "library": one_line(trace.library),
        "truncated": trace.truncated,
        "damage": _some(trace.damage),
        "warnings": _some(trace.warnings),
        "labels": _labels(trace.metadata),
        "topics": [
            {
                "topic": one_line(c.topic),
                "type": one_line(c.type_name),
                "messages": c.message_count,
                "mean_hz": _rate(c.message_count, (c.last_ns - c.first_ns) / 1e9),
            }
            for c in trace.channels
        ],
    }


def _labels(metadata: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    found: dict[str, str] = {}
    for record in metadata.values():
        for key, value in record.items():
            if key.lower() in _LABELS and value:
                found.setdefault(key.lower(), one_line(redact(value), 100))
    return found


def _rate(count: int, seconds: float) -> float | None:
    return round((count - 1) / seconds, 3) if count > 1 and seconds > 0 else None


def _facts_of_recording(view: Recording) -> dict[str, Any]:
    sides = {}
    for side in view.judged:
        hand = view.sides[side]
        sides[str(side)] = {"states": _pace(hand.states.t), "commands": _pace(hand.commands.t)}
    return {
        "model": view.model.name,
        "dialect": view.dialect.name,
        "layer": view.layer,
        "live": view.stimulus is not None,
        "sides": sides,
    }


def _pace(times: Floats) -> dict[str, Any]:
    """Messages, rate and intervals of one side's states or commands, by reception."""
    found: dict[str, Any] = {"messages": len(times)}
    if len(times) > 1:
        intervals = np.diff(times)
        last = len(intervals) - 1
        middle, high = last // 2, round(0.99 * last)
        ordered = np.sort(intervals)  # to find two of them takes longer
        found["mean_hz"] = _rate(len(times), float(times[-1] - times[0]))
        found["p50_s"] = round(float(ordered[middle]), 6)
        found["p99_s"] = round(float(ordered[high]), 6)
        found["max_s"] = round(float(ordered[-1]), 6)
    return found


def _facts_of_result(result: RunResult) -> dict[str, Any]:
    return {
        "stage": {side: str(stage) for side, stage in result.stage.items()},
        "notes": _some(result.notes),
    }
