"""Judge episodes of an archive; whatever is wrong with one becomes its record."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from dexkit import __version__
from dexkit.conformance.audit.objects import file_system
from dexkit.conformance.audit.records import EpisodeRecord, RequirementFinding, State
from dexkit.conformance.audit.sessions import is_url, opened, problem_of
from dexkit.conformance.audit.units import Form, Unit, fetch, tag_of_metadata
from dexkit.conformance.dataset.cameras import not_judged
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Judgement, Use
from dexkit.conformance.dataset.judge import checks_digest
from dexkit.conformance.dataset.judge import judge as judge_episode
from dexkit.conformance.dataset.read import (
    episode_of_dataset,
    episode_of_recording,
    read_quickly,
)
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.results import Overall, RunResult, overall_of
from dexkit.conformance.kit.run_record import catalogue_digest, recorded_claims
from dexkit.errors import DexkitError, SessionError
from dexkit.escaping import one_line
from dexkit.hand import Floats
from dexkit.redaction import redact
from dexkit.temporary_folder import TemporaryFolder
from dexkit.traces import Trace, open_trace
from dexkit.traces.sessions.episodes import DATA
from dexkit.traces.sessions.judgeable import judgeable
from dexkit.traces.sessions.lerobot_in import Dataset

__all__ = ["Task", "examine", "settings_key"]

_LABELS = ("robot", "operator", "task", "site")
"""Keys of a recording's metadata, in any of its records, by which an audit groups sessions."""
_SOME = 5  # of a file's warnings are kept
_TEXT = 500  # characters of each
_CUT = "the recording is cut or damaged: messages are lost"
_MORE_MEMORY = "--set memory=MIB"


@dataclass(frozen=True)
class Task:
    """Episodes to be examined: one, or some of one data file.

    :param known: of a recording, the SHA-256 that it had when it was examined the last time.
    :param max_size: bytes of an object that are copied; larger ones are read by ranges.
    :param cameras: whether pictures are looked at.
    """

    units: tuple[Unit, ...]
    known: str = ""
    max_size: int = 2**33
    cameras: bool = True

    @property
    def size(self) -> int:
        """Bytes, about."""
        return sum(unit.size for unit in self.units)


def settings_key(cameras: bool = True) -> str:
    """Key of the settings; records are reused only if it is equal."""
    looked = "cameras" if cameras else "no cameras"
    return ",".join([__version__, catalogue_digest(), checks_digest(), looked, *_LABELS])


def examine(task: Task) -> list[EpisodeRecord]:
    """Judge episodes. Raises nothing but what ends the process.

    :returns: their records in order; that of a recording is without findings, and has ``sha256``
        equal to ``task.known``, if the file is the one that was examined before.
    """
    records: list[EpisodeRecord] = []
    begin = time.process_time()
    for unit, find_record in _work(task):
        digest: list[str] = []
        try:
            record = find_record(digest)
        except (DexkitError, OSError, MemoryError) as error:
            record = problem_of(unit.name, error, unit.place)
            if isinstance(error, MemoryError):
                record.error, record.hint = "it needs more memory than it may use", _MORE_MEMORY
        except Exception as error:  # of a storage, or a mistake of dexkit: a row, not an end
            record = problem_of(unit.name, error, unit.place)
            if digest or not is_url(unit.place):
                record.state = State.FAILED
                record.error = f"{_where()}: {record.error}"
                record.hint = "please report this, with the file if you can"
        record.size, record.tag = unit.size, unit.tag
        record.sha256 = digest[0] if digest else record.sha256
        record.source, record.episode = unit.source, unit.episode
        record.settings = settings_key(task.cameras)
        record.dexkit, record.catalogue = __version__, catalogue_digest()
        now = time.process_time()
        record.facts["cpu_s"], begin = round(now - begin, 4), now
        records.append(record)
    return records


_Examine = Callable[[list[str]], EpisodeRecord]


def _work(task: Task) -> Iterator[tuple[Unit, _Examine]]:
    """Each episode with the function that judges it, which is given a list for the digest."""
    first = task.units[0]
    if first.form is Form.RECORDING:
        yield first, lambda digest: _of_recording(first, task, digest)
    elif first.form is Form.BAG:
        yield first, lambda digest: _of_bag(first)
    elif first.form is Form.FOLDER:
        yield first, lambda digest: _of_folder(first, task)
    else:
        yield from _of_dataset(task)


def _of_recording(unit: Unit, task: Task, digest: list[str]) -> EpisodeRecord:
    with opened(unit.place, unit.name, task.max_size) as (path, open_file, sha256):
        digest.append(sha256)
        if sha256 == task.known:
            return EpisodeRecord(unit.name, state=State.JUDGED)
        return _judged(lambda: open_trace(path, open_file), path, unit.name, ())


def _of_bag(unit: Unit) -> EpisodeRecord:
    with judgeable(Path(unit.place)) as (trace, notes):
        return _judged(lambda: trace, Path(unit.place), unit.name, notes or ())


def _of_folder(unit: Unit, task: Task) -> EpisodeRecord:
    if not is_url(unit.place):
        return _of_episode(unit.name, read_quickly(Path(unit.place)), task.cameras)
    with TemporaryFolder("audit") as folder:
        fetch(unit.place, [DATA], folder)
        return _of_episode(unit.name, read_quickly(folder), cameras=False)


def _of_dataset(task: Task) -> Iterator[tuple[Unit, _Examine]]:
    first = task.units[0]
    numbers = [unit.number for unit in task.units]
    with contextlib.ExitStack() as stack:
        root, cameras = Path(first.place), task.cameras
        try:
            if is_url(first.place):
                # videos stay where they are: an episode may have gigabytes of them
                root, cameras = stack.enter_context(TemporaryFolder("audit")), False
                fetch(first.place, [*_metadata(first.place), first.data], root)
            dataset = _dataset(root, tag_of_metadata(root))
        except Exception as error:
            reason = error

            def refuse(digest: list[str]) -> EpisodeRecord:
                raise reason

            yield from ((unit, refuse) for unit in task.units)
            return
        dataset.only = min(numbers), max(numbers)
        for unit in task.units:
            yield (
                unit,
                lambda digest, unit=unit: _of_episode(  # type: ignore[misc]
                    unit.name, episode_of_dataset(dataset, unit.number), cameras
                ),
            )


def _metadata(url: str) -> list[str]:
    files, root = file_system(url)
    return [p.removeprefix(f"{root}/") for p in files.find(f"{root}/meta")]


@lru_cache(maxsize=1)
def _dataset(root: Path, tag: str) -> Dataset:
    """The dataset, read once for the tasks of this process that follow each other.

    :param tag: another one where the metadata have changed.
    """
    return Dataset(root)


def _of_episode(name: str, episode: Episode, cameras: bool) -> EpisodeRecord:
    if not cameras:
        episode.cameras = ()
    judgement = judge_episode(episode)
    return EpisodeRecord(
        name,
        state=State.JUDGED,
        sha256=judgement.key,
        form=episode.form,
        judgement=judgement,
        exit_code=int(judgement.use is Use.DROP),
        facts={
            "duration_s": round(episode.duration, 3),
            "messages": len(episode),
            "model": _models(episode),
            "labels": {"task": one_line(episode.tasks[0], 100)} if episode.tasks else {},
            "notes": _some([*not_judged(episode), *episode.problems]),
        },
    )


def _models(episode: Episode) -> str:
    names = [track.model.name for track in episode.tracks if track.model is not None]
    return "+".join(dict.fromkeys(names))


def _where() -> str:
    """The innermost place of the exception that is being handled."""
    trace = sys.exc_info()[2]
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "?" if trace is None else f"{trace.tb_frame.f_code.co_name}:{trace.tb_lineno}"


def _judged(
    open_it: Callable[[], Trace], path: Path, name: str, notes: Sequence[str]
) -> EpisodeRecord:
    """The record of a recording: as ``dexkit check`` judges it, and whether to train on it.

    :param notes: what an import changed or left out.
    """
    facts: dict[str, Any] = {}
    judgement: Judgement | None = None
    form = ""
    try:
        trace = open_it()
        facts = _facts_of_trace(trace)
        with contextlib.suppress(SessionError):
            episode = episode_of_recording(trace, name)
            episode.problems.extend(notes)
            if trace.truncated or trace.damage:
                episode.problems.append(_CUT)
            judgement, form = judge_episode(episode), episode.form
        view = recording_of(trace, None, ())
        facts |= _facts_of_recording(view)
        result = judge(view, claims=recorded_claims(view.run))
        facts |= _facts_of_result(result)
    except DexkitError as error:
        record = problem_of(name, error)
        record.error = record.error.replace(str(path), name)
        record.facts, record.judgement, record.form = facts, judgement, form
        if judgement is not None:  # joints of no hand that has requirements
            record.state, record.error, record.hint = State.JUDGED, "", ""
            record.exit_code = int(judgement.use is Use.DROP)
        return record
    about = "robot" if view.layer == "robot" else "hand"
    damage = facts["damage"] = _some(trace.damage)
    facts["warnings"] = _some(trace.warnings)
    if not result.judged and judgement is not None:
        state, error_text = State.JUDGED, ""
    elif not result.judged:
        state, error_text = State.NOT_JUDGED, "nothing was judged, which is not a pass"
    elif damage:
        state, error_text = State.JUDGED, f"damaged: {damage[0]}"
    else:
        open_must = result.overall is Overall.INCONCLUSIVE
        state, error_text = State.JUDGED, result.sentence() if open_must else ""
    return EpisodeRecord(
        name,
        state=state,
        error=error_text,
        overall=str(result.overall),
        client=str(overall_of(result.client)) if result.client else "",
        exit_code=2 if error_text else _exit_code(result, judgement),
        form=form,
        judgement=judgement,
        facts=facts,
        findings=[
            *(RequirementFinding.of(r, about) for r in result.results),
            *(RequirementFinding.of(r, "client") for r in result.client),
        ],
    )


def _exit_code(result: RunResult, judgement: Judgement | None) -> int:
    dropped = judgement is not None and judgement.use is Use.DROP
    return max(result.exit_code() if result.judged else 0, int(dropped))


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
