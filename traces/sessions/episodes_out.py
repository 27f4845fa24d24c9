"""Write episodes as xr_teleoperate does since v1.3.

A session that was imported from an episode is written with its original frames and items; any other
recording is sampled at one rate.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit import __version__
from dexkit.errors import DexkitError, SessionError, WireError
from dexkit.hand import Floats
from dexkit.staging import whole_folder
from dexkit.traces.reader import LATEST_NS, Trace
from dexkit.traces.sessions import ros_types
from dexkit.traces.sessions.episodes import DATA
from dexkit.traces.sessions.frames import RULE, Source, open_source, sample
from dexkit.traces.sessions.imported import RECORD
from dexkit.traces.sessions.lerobot_out import Result
from dexkit.traces.sessions.model import REST_TOPIC
from dexkit.traces.sessions.paths import below
from dexkit.traces.sessions.pictures import parse_picture
from dexkit.traces.sessions.resample import hold, interpolate
from dexkit.traces.sessions.streams import COMMAND, HAND, STATE, Pressure, Stream
from dexkit.traces.sessions.typed import parse_record

__all__ = ["export_episodes"]

_KEYS = {STATE: "states", COMMAND: "actions"}
_COLUMNS = {"q": "qpos", "dq": "qvel", "tau": "torque"}
_EXTENSION = "dexkit"


def export_episodes(
    traces: Sequence[Trace],
    out: Path,
    *,
    fps: int | None = None,
    task: str | None = None,
    pictures: Path | None = None,
) -> Result:
    """Write recordings as the episodes of a task folder.

    :param fps: frames a second of recordings that are sampled; None for their own rate.
    :param task: of all episodes; None for what each recording says.
    :param pictures: the folder that was imported, with the pictures that are not in the recordings.
    :raises SessionError: ``out`` exists, cannot be written, or no recording can be used.
    """
    result = Result()
    with whole_folder(out, error=SessionError) as root:
        for trace in traces:
            try:
                for info, text, items, files in _episodes(trace, fps, task, pictures, result):
                    folder = root / f"episode_{result.episodes:04d}"
                    _write(folder, files, _text(info, text, items))
                    result.episodes += 1
                    result.frames += len(items)
            except DexkitError as error:
                if len(traces) == 1:
                    raise
                result.problems.append(f"{trace.path.name}: refused: {error.message}")
        if not result.episodes:
            raise SessionError("none of the recordings can be exported")
    return result


def _write(folder: Path, files: Sequence[tuple[str, bytes]], text: bytes) -> None:
    for kind in ("colors", "depths", "audios"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for name, data in files:
        target = below(folder, name)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    (folder / DATA).write_bytes(text)


def _text(info: Any, text: Any, items: Sequence[Any]) -> bytes:
    """The file in xr_teleoperate's layout, except that each item is on one line."""
    head = (json.dumps(value, ensure_ascii=False, indent=4) for value in (info, text))
    frames = ",\n".join(json.dumps(item, ensure_ascii=False) for item in items)
    text = '{{\n"info": {},\n"text": {},\n"data": [\n{}\n]\n}}'.format(*head, frames)
    return str(text).encode("utf-8", "backslashreplace")


Episode = tuple[Any, Any, "list[dict[str, Any]]", "list[tuple[str, bytes]]"]


def _episodes(
    trace: Trace, fps: int | None, task: str | None, folder: Path | None, result: Result
) -> Iterator[Episode]:
    source = open_source(trace, folder)
    if source.imported.names is not None and fps is None:
        yield _as_it_was(source, source.imported.names, task, result)
        return
    rate = fps or max(1, round(source.rate))
    result.fps = rate
    runs, told = sample(source, rate)
    lost = ["times of the recording: the rate stands in info.image.fps, the start in info.dexkit"]
    lost += [f"{trace.path.name}: {text}" for text in source.lost]
    result.problems += [f"{trace.path.name}: {text}" for text in (*source.problems, *told)]
    result.lost += [text for text in lost if text not in result.lost]
    parts = sorted({s.part for s in source.streams})
    for frames in runs:
        items, pictures = [], []
        for i, time_ns in enumerate(frames.times_ns.tolist()):
            item: dict[str, Any] = {"idx": i, "timestamp_ns": time_ns, "colors": {}, "depths": {}}
            for kind, key in _KEYS.items():
                item[key] = {_name(p): _entry({}) for p in parts} | {"body": {"qpos": []}}
                for s in source.streams:
                    if s.kind == kind:
                        row = {f: frames.values[s.part, kind, f][i] for f in s.values}
                        item[key][_name(s.part)] = _entry(row)
            for p in source.pictures:
                data = p.load(int(frames.pictures[p.camera][i]))
                picture = parse_picture(data) if data is not None else None
                if data is None or picture is None:
                    text = f"{trace.path.name}: {p.camera}: pictures that cannot be read"
                    if text not in result.problems:
                        result.problems.append(text)
                    continue
                suffix = "jpg" if picture.form == "jpeg" else "png"
                path = f"colors/{i:06d}_{p.camera}.{suffix}"
                item["colors"][p.camera] = path
                pictures.append((path, data))
            pressed = {
                _name(part): [float(v) for v in table[i]] for part, table in frames.pressure.items()
            }
            item |= {"tactiles": pressed or None, "audios": None, "sim_state": None}
            items.append(item)
        goal = task or source.imported.task
        info = _info(source, rate, result, int(frames.times_ns[0]))
        yield info, {"goal": goal, "desc": "", "steps": ""}, items, pictures


def _info(source: Source, rate: int, result: Result, start_ns: int) -> dict[str, Any]:
    joints = {_name(s.part): list(s.names) for s in source.streams}
    elements = {_name(tactile.part): list(tactile.elements) for tactile in source.pressures}
    return {
        "version": "1.0.0",
        "date": "",
        "author": f"dexkit {__version__}",
        "image": {"width": 0, "height": 0, "fps": rate},
        "depth": {"width": 0, "height": 0, "fps": rate},
        "audio": {"sample_rate": 16000, "channels": 1, "format": "PCM", "bits": 16},
        "joint_names": joints,
        "tactile_names": elements,
        "sim_state": "",
        _EXTENSION: {
            "source": source.trace.path.name,
            "start_ns": start_ns,
            "resampling": RULE,
            "measured_hz": {k: round(v, 4) for k, v in source.measured.items()},
            "tactile_at_rest": {_name(p.part): p.at_rest for p in source.pressures if not p.zeroed},
            "lost": list(result.lost),
        },
    }


def _name(part: str) -> str:
    """xr_teleoperate's name of a part."""
    return f"{part.removesuffix(HAND)}_ee" if part.endswith(HAND) else part


def _entry(row: Mapping[str, Floats]) -> dict[str, list[float]]:
    return {c: row[f].tolist() if f in row else [] for f, c in _COLUMNS.items()}


def _as_it_was(
    source: Source, names: Mapping[str, str], task: str | None, result: Result
) -> Episode:
    """The original frames of an imported episode.

    :raises SessionError: the recording is not as its import wrote it.
    """
    imported, trace = source.imported, source.trace
    result.problems += [f"{trace.path.name}: {text}" for text in source.problems]
    rest = _rest(trace)
    pictured = [*source.pictures, *source.absent]
    if imported.aligned:  # every frame has its number, and the hands come from the DDS recording
        times = set(rest)
    else:
        times = {t for s in source.streams for t in s.times_ns.tolist()} | rest.keys()
        times |= {t for p in pictured for t in p.times_ns.tolist()}
    ordered = sorted(times)
    first, rate = imported.first_ns, imported.rate_hz
    items: dict[int, dict[str, Any]] = {}
    current: dict[str, Any] = {}
    for i, t in enumerate(ordered):
        current = rest.get(t, current)
        item = json.loads(json.dumps(current))
        if "idx" not in item:
            number = i if first is None else round((t - first) * rate / 1e9)
            item = {"idx": number, **item}
        items[t] = item
    for s in source.streams:
        name = names.get(s.part, s.part)
        if imported.aligned and s.samples is not None and s.model:
            found = _at_frames(s, ordered)
            _fill(found, items, name)
            if len(found) < len(ordered):
                result.problems.append(
                    f"{trace.path.name}: {name}: {len(ordered) - len(found)} of {len(ordered)} "
                    f"frames lie in gaps of the recording and have no {_KEYS[s.kind]}"
                )
        else:
            _at_items(trace, s.topic, s.times_ns, items)
            _fill(s, items, name)
    if imported.aligned:
        for tactile in source.pressures:
            _add_tactile(tactile, items, names.get(tactile.part, tactile.part))
        for t, item in items.items():
            item["timestamp_ns"] = t
    pictures: list[tuple[str, bytes]] = []
    for p in pictured:
        _at_items(trace, p.camera, p.times_ns, items)
        group = imported.cameras[p.camera]
        for i, t in enumerate(p.times_ns.tolist()):
            path = p.paths[i] if p.paths else f"{group}/{i:06d}_{p.camera}.jpg"
            entry = items[t].setdefault(group, {})
            if isinstance(entry, dict):
                entry[p.camera] = path
            if p in source.absent:
                continue
            data = p.load(i)
            if data is not None:
                pictures.append((path, data))
            elif (text := f"{trace.path.name}: {p.camera}: pictures that cannot be read") not in (
                result.problems
            ):
                result.problems.append(text)
    record = trace.metadata.get(RECORD, {})
    for key in record:
        if key.startswith(("rounded ", "correction ")):
            result.lost.append(f"{trace.path.name}: {key}: {record[key]}")
    result.fps = result.fps or round(rate)
    words = dict(imported.text)
    if task is not None:
        words["goal"] = task
    return imported.info, words, [items[t] for t in ordered], pictures


def _rest(trace: Trace) -> dict[int, dict[str, Any]]:
    """By time, what an imported episode has beside joints and pictures.

    :raises SessionError: a message has another form.
    """
    found = {}
    for m in trace.messages([REST_TOPIC]) if REST_TOPIC in trace.topics else ():
        origin = f"{trace.path}: {REST_TOPIC} at {m.log_time_ns} ns"
        try:
            text = ros_types.decode_string(m.data)
        except WireError as error:
            raise SessionError(f"{origin}: {error}") from error
        found[min(m.log_time_ns, LATEST_NS)] = parse_record(text, dict[str, Any], origin)
    return found


def _at_items(
    trace: Trace, what: str, times: NDArray[np.int64], items: Mapping[int, dict[str, Any]]
) -> None:
    """Check that all of a stream's times are those of frames.

    :raises SessionError: they are not.
    """
    for t in times.tolist():
        if t not in items:
            raise SessionError(
                f"{trace.path}: {what}: {t} ns is not the time of a frame of the imported episode",
                hint="--set fps=N samples the recording instead",
            )


def _at_frames(stream: Stream, times: Sequence[int]) -> Stream:
    """A recorded stream at the times of the frames, without frames in its gaps."""
    at = np.array(times, dtype=np.int64)
    method = hold if stream.kind == COMMAND else interpolate
    values = {f: method(stream.times_ns, v, at) for f, v in stream.values.items()}
    good = np.isfinite(values["q"]).all(axis=1)
    return replace(
        stream,
        times_ns=at[good],
        values={f: v[good] for f, v in values.items()},
        pressure=None,
        samples=None,
    )


def _fill(stream: Stream, items: Mapping[int, dict[str, Any]], name: str) -> None:
    """Insert the values of a stream at their original places."""
    key = _KEYS[stream.kind]
    for suffix in (f"_{STATE}", f"_{COMMAND}"):
        name = name.removesuffix(suffix)
    columns = {c: stream.values[f] for f, c in _COLUMNS.items() if f in stream.values}
    for i, t in enumerate(stream.times_ns.tolist()):
        group = items[t].setdefault(key, {})
        if not isinstance(group, dict):
            continue
        entry = group.setdefault(name, {})
        if isinstance(entry, dict):
            for column, table in columns.items():
                row: list[float] = np.asarray(table[i]).tolist()
                entry[column] = row


def _add_tactile(tactile: Pressure, items: Mapping[int, dict[str, Any]], name: str) -> None:
    """Insert the pressures of a hand, except in gaps."""
    for suffix in (f"_{STATE}", f"_{COMMAND}"):
        name = name.removesuffix(suffix)
    times = np.array(sorted(items), dtype=np.int64)
    for t, known, row in zip(
        times.tolist(), tactile.is_known(times), tactile.at(times), strict=True
    ):
        if known and isinstance(items[t].get("tactiles") or {}, dict):
            pressed = items[t]["tactiles"] = items[t].get("tactiles") or {}
            pressed[name] = np.nan_to_num(row).tolist()
