"""Write LeRobot datasets v3.0, directly (docs/sources/sessions.md#c2).

Every recording is an episode, or several where it has gaps. Features are named by joint; pictures
are embedded without being encoded again.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit import __version__
from dexkit.digests import sha256_of_file
from dexkit.errors import DexkitError, ExtraMissing, SessionError
from dexkit.robots import ROBOTS
from dexkit.staging import whole_folder
from dexkit.traces.reader import Trace
from dexkit.traces.sessions.frames import RULE, Frames, Source, open_source, sample
from dexkit.traces.sessions.lerobot_format import (
    ACTION,
    COLUMNS,
    EXTENSION,
    PICTURES,
    PRESSURE,
    STATE_COLUMN,
    parquet_library,
    write_json,
)
from dexkit.traces.sessions.lerobot_stats import Aggregate, statistics
from dexkit.traces.sessions.pictures import parse_picture
from dexkit.traces.sessions.streams import COMMAND, STATE

__all__ = ["TASKS_METADATA", "Result", "describe", "export_dataset"]

_CHUNK = 1000  # files in a folder
_FILE_MB = 100
# Pictures of an episode whose pixels are counted.
_SAMPLED = 16
_UNNAMED = "unnamed task"


@dataclass
class Result:
    """Result of an export.

    :param lost: data that the dataset cannot represent.
    :param problems: omitted data and refused recordings.
    """

    episodes: int = 0
    frames: int = 0
    fps: int = 0
    lost: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Feature:
    """A vector of the dataset: the parts and the field that it is made of."""

    name: str
    kind: str
    field: str
    parts: tuple[str, ...]
    names: tuple[str, ...]

    def matrix(self, frames: Frames) -> NDArray[np.float32]:
        if self.field == "pressure":
            tables = [frames.pressure[p] for p in self.parts]
        else:
            tables = [frames.values[p, self.kind, self.field] for p in self.parts]
        with np.errstate(over="ignore"):
            return np.concatenate(tables, axis=1).astype(np.float32)


@dataclass(frozen=True)
class _Scheme:
    """The features shared by all episodes of a dataset."""

    features: tuple[_Feature, ...]
    parts: tuple[dict[str, Any], ...]
    cameras: tuple[tuple[str, int, int, int], ...]
    robot: str


def export_dataset(
    traces: Sequence[Trace],
    out: Path,
    *,
    fps: int | None = None,
    task: str | None = None,
    pictures: Path | None = None,
) -> Result:
    """Write recordings as one dataset, a folder.

    :param fps: frames a second; None for the rate of the first recording's pictures, commands or
        states.
    :param task: of all episodes; None for what each recording says.
    :param pictures: the folder that was imported, with the pictures that are not in the recordings.
    :raises ExtraMissing: pyarrow or Pillow is not installed.
    :raises SessionError: ``out`` exists, cannot be written, or no recording can be used.
    """
    parquet_library()
    with whole_folder(out, error=SessionError) as root:
        writer = _Writer(root, fps, task, pictures)
        for trace in traces:
            try:
                writer.add(trace)
            except DexkitError as error:
                if isinstance(error, ExtraMissing) or len(traces) == 1:
                    raise
                writer.result.problems.append(f"{trace.path.name}: refused: {error.message}")
        writer.close()
    return writer.result


class _Writer:
    def __init__(
        self, root: Path, fps: int | None, task: str | None, pictures: Path | None
    ) -> None:
        self._arrow, self._parquet = parquet_library()
        self.root = root
        self.result = Result(fps=fps or 0)
        self._task = task
        self._folder = pictures
        self._scheme: _Scheme | None = None
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._origins: dict[str, dict[str, str]] = {}
        self._measured: dict[str, dict[str, float]] = {}
        self._at_rest: dict[str, dict[str, list[float | None]]] = {}
        self._all: dict[str, list[NDArray[Any]]] = {}
        self._picture_stats: dict[str, Aggregate] = {}
        self._file: Any = None
        self._place = (0, 0)
        self._lost: dict[str, None] = {}

    def add(self, trace: Trace) -> None:
        """Add a recording.

        :raises SessionError: it cannot be used, or has other joints than the first one.
        """
        source = open_source(trace, self._folder)
        name = trace.path.name
        scheme = _scheme(source)
        if self._scheme is None:
            self.result.fps = self.result.fps or max(1, round(source.rate))
        elif scheme != self._scheme:
            raise SessionError("it has other joints, fields or cameras than the first recording")
        runs, told = sample(source, self.result.fps)
        for feature in scheme.features:
            if not all(np.isfinite(feature.matrix(frames)).all() for frames in runs):
                raise SessionError(f"{name}: {feature.name} has values that no float32 can hold")
        # before anything is written: a picture that cannot be read refuses the whole recording
        pictures = [_load(source, frames, scheme) for frames in runs]
        seen = [{c: _picture_statistics(c, data) for c, data in p.items()} for p in pictures]
        self._scheme = scheme
        self._measured[name] = {k: round(v, 4) for k, v in source.measured.items()}
        self._at_rest[name] = {p.part: p.at_rest for p in source.pressures if not p.zeroed}
        self.result.problems += [f"{name}: {text}" for text in (*source.problems, *told)]
        self._lost.update(dict.fromkeys(f"{name}: {text}" for text in source.lost))
        digest = sha256_of_file(trace.path)  # once: a long recording has many runs
        for frames, loaded, found in zip(runs, pictures, seen, strict=True):
            self._add(source, digest, frames, loaded, found, scheme)

    def _add(
        self,
        source: Source,
        digest: str,
        frames: Frames,
        pictures: dict[str, list[bytes]],
        seen: dict[str, dict[str, list[Any]]],
        scheme: _Scheme,
    ) -> None:
        episode, n = len(self._episodes), len(frames)
        task = self._task or source.imported.task or _UNNAMED
        number = self._tasks.setdefault(task, len(self._tasks))
        first = self.result.frames
        vectors: dict[str, NDArray[Any]] = {f.name: f.matrix(frames) for f in scheme.features}
        plain: dict[str, NDArray[Any]] = {
            "timestamp": (np.arange(n) / self.result.fps).astype(np.float32),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, episode),
            "index": np.arange(first, first + n),
            "task_index": np.full(n, number),
        }
        stats = {k: statistics(v) for k, v in (vectors | plain).items()}
        for camera, found in seen.items():
            stats[PICTURES + camera] = found
            self._picture_stats.setdefault(PICTURES + camera, Aggregate()).add(found)
        for k, v in (vectors | plain).items():
            self._all.setdefault(k, []).append(v)
        self._write(vectors, plain, pictures)
        chunk, file = self._place
        row: dict[str, Any] = {
            "episode_index": episode,
            "tasks": [task],
            "length": n,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": first,
            "dataset_to_index": first + n,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        row.update({f"stats/{k}/{s}": v for k, found in stats.items() for s, v in found.items()})
        self._episodes.append(row)
        self._origins[str(episode)] = {
            "file": source.trace.path.name,
            "sha256": digest,
            "start_ns": str(int(frames.times_ns[0])),
            "clock": source.imported.clock,
        }
        self.result.episodes += 1
        self.result.frames += n

    def _write(
        self,
        vectors: dict[str, NDArray[Any]],
        plain: dict[str, NDArray[Any]],
        pictures: dict[str, list[bytes]],
    ) -> None:
        arrow = self._arrow
        columns: dict[str, Any] = {}
        for name, matrix in vectors.items():
            flat = arrow.array(matrix.reshape(-1), type=arrow.float32())
            width = matrix.shape[1]
            # a vector of one number is a number there
            columns[name] = (
                flat if width == 1 else arrow.FixedSizeListArray.from_arrays(flat, width)
            )
        for camera, data in pictures.items():
            kind = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
            rows = [{"bytes": d, "path": f"frame-{i:06d}"} for i, d in enumerate(data)]
            columns[PICTURES + camera] = arrow.array(rows, type=kind)
        columns.update({k: arrow.array(v) for k, v in plain.items()})
        table = arrow.table(columns)
        described = {"info": {"features": {k: _huggingface(k, t.type) for k, t in columns.items()}}}
        table = table.replace_schema_metadata({"huggingface": json.dumps(described)})
        if self._file is not None and self._path().stat().st_size > _FILE_MB * 2**20:
            self._file.close()
            self._file = None
            chunk, file = self._place
            self._place = (chunk, file + 1) if file + 1 < _CHUNK else (chunk + 1, 0)
        if self._file is None:
            self._path().parent.mkdir(parents=True, exist_ok=True)
            self._file = self._parquet.ParquetWriter(
                str(self._path()), table.schema, compression="snappy"
            )
        self._file.write_table(table)

    def _path(self) -> Path:
        chunk, file = self._place
        return self.root / f"data/chunk-{chunk:03d}/file-{file:03d}.parquet"

    def close(self) -> None:
        """Write totals and statistics.

        :raises SessionError: there is no episode.
        """
        if self._scheme is None or self._file is None:
            raise SessionError(
                "none of the recordings can be exported", hint="; ".join(self.result.problems[:3])
            )
        self._file.close()
        arrow = self._arrow
        meta = self.root / "meta"
        (meta / "episodes" / "chunk-000").mkdir(parents=True)
        self._parquet.write_table(
            arrow.Table.from_pylist(self._episodes),
            str(meta / "episodes" / "chunk-000" / "file-000.parquet"),
        )
        tasks = arrow.table(
            {"task_index": arrow.array(range(len(self._tasks))), "task": list(self._tasks)}
        )
        tasks = tasks.replace_schema_metadata(TASKS_METADATA)
        self._parquet.write_table(tasks, str(meta / "tasks.parquet"))
        stats = {k: statistics(np.concatenate(v)) for k, v in self._all.items()}
        stats |= {k: v.statistics() for k, v in self._picture_stats.items()}
        self.result.lost = [
            "times beside those of the frames, payloads, and topics without joints or pictures",
            *self._lost,
        ]
        write_json(meta / "stats.json", stats)
        write_json(meta / "info.json", self._info())

    def _info(self) -> dict[str, Any]:
        assert self._scheme is not None
        features: dict[str, Any] = {
            f.name: {"dtype": "float32", "shape": [len(f.names)], "names": list(f.names)}
            for f in self._scheme.features
        }
        for camera, height, width, channels in self._scheme.cameras:
            features[PICTURES + camera] = {
                "dtype": "image",
                "shape": [height, width, channels],
                "names": ["height", "width", "channels"],
            }
        for name in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
            dtype = "float32" if name == "timestamp" else "int64"
            features[name] = {"dtype": dtype, "shape": [1], "names": None}
        return {
            "codebase_version": "v3.0",
            "robot_type": self._scheme.robot,
            "total_episodes": self.result.episodes,
            "total_frames": self.result.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": _FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": self.result.fps,
            "splits": {"train": f"0:{self.result.episodes}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "features": features,
            EXTENSION: {
                "version": __version__,
                "resampling": RULE,
                "measured_hz": self._measured,
                "pressure_at_rest": self._at_rest,
                "parts": list(self._scheme.parts),
                "sessions": self._origins,
                "lost": self.result.lost,
            },
        }


_PANDAS = {
    "index_columns": ["task"],
    "column_indexes": [
        {
            "name": None,
            "field_name": None,
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": {"encoding": "UTF-8"},
        }
    ],
    "columns": [
        {
            "name": name,
            "field_name": name,
            "pandas_type": kind,
            "numpy_type": numpy,
            "metadata": None,
        }
        for name, kind, numpy in (
            ("task_index", "int64", "int64"),
            ("task", "unicode", "object"),
        )
    ],
    "creator": {"library": "dexkit", "version": __version__},
    "pandas_version": "2.0.0",
}
TASKS_METADATA = {"pandas": json.dumps(_PANDAS)}
"""Of the schema of ``meta/tasks.parquet``: LeRobot finds tasks by pandas' index."""


def _huggingface(name: str, kind: Any) -> dict[str, Any]:
    """A column as the library datasets describes it."""
    if name.startswith(PICTURES):
        return {"_type": "Image"}
    if hasattr(kind, "list_size"):
        inner = {"dtype": "float32", "_type": "Value"}
        return {"feature": inner, "length": kind.list_size, "_type": "List"}
    return {"dtype": "float32" if str(kind) == "float" else "int64", "_type": "Value"}


def _scheme(source: Source) -> _Scheme:
    streams = sorted(source.streams, key=lambda s: (s.part not in ROBOTS, s.part, s.kind))
    by_kind = {k: [s for s in streams if s.kind == k] for k in (STATE, COMMAND)}
    features = []
    for (kind, name), column in COLUMNS.items():
        own = by_kind[kind]
        if not own or any(name not in s.values for s in own):
            continue
        members = tuple(s.part for s in own)
        features.append(_Feature(column, kind, name, members, _names(own)))
    if pressed := source.pressures:
        names = tuple(name for tactile in pressed for name in tactile.names)
        features.append(
            _Feature(PRESSURE, STATE, "pressure", tuple(tactile.part for tactile in pressed), names)
        )
    parts: dict[str, dict[str, Any]] = {}
    for feature in features:
        if feature.name in (STATE_COLUMN, ACTION):
            own = by_kind[feature.kind]
            at = 0
            for s in own:
                names = feature.names[at : at + len(s.joints)]
                at += len(s.joints)
                parts.setdefault(
                    s.part,
                    {
                        "part": s.part,
                        "joints": list(s.joints),
                        "features": list(names),
                        "model": "" if s.model in ROBOTS else s.model,
                    },
                )
    cameras = []
    for p in source.pictures:
        first = p.load(0)
        picture = parse_picture(first) if first is not None else None
        if picture is None:
            source.problems.append(f"{p.camera} is left out: its first picture cannot be read")
            continue
        cameras.append((p.camera, picture.height, picture.width, picture.channels))
    kept = {c[0] for c in cameras}
    source.pictures = [p for p in source.pictures if p.camera in kept]
    robot = "+".join(dict.fromkeys(s.model for s in streams if s.model)) or "unknown"
    return _Scheme(tuple(features), tuple(parts.values()), tuple(cameras), robot)


def _names(streams: Sequence[Any]) -> tuple[str, ...]:
    """A unique name for each joint."""
    plain = [n for s in streams for n in s.names]
    if len(set(plain)) == len(plain):
        return tuple(plain)
    return tuple(f"{s.part}_{j}" for s in streams for j in s.joints)


def _load(source: Source, frames: Frames, scheme: _Scheme) -> dict[str, list[bytes]]:
    """The pictures of a run of frames.

    :raises SessionError: one cannot be read, or is of another size than the first.
    """
    sizes = {name: (h, w, c) for name, h, w, c in scheme.cameras}
    found = {}
    for p in source.pictures:
        loaded: dict[int, bytes] = {}
        for place in dict.fromkeys(frames.pictures[p.camera].tolist()):
            data = p.load(place)
            picture = parse_picture(data) if data is not None else None
            where = p.paths[place] if p.paths else f"picture {place}"
            if data is None or picture is None:
                raise SessionError(
                    f"{source.trace.path.name}: {p.camera}: {where} is missing or no picture"
                )
            if (picture.height, picture.width, picture.channels) != sizes[p.camera]:
                raise SessionError(
                    f"{source.trace.path.name}: {p.camera}: {where} has another size"
                )
            loaded[place] = data
        found[p.camera] = [loaded[i] for i in frames.pictures[p.camera].tolist()]
    return found


def _picture_statistics(camera: str, data: Sequence[bytes]) -> dict[str, list[Any]]:
    """Statistics of the channels of some pictures of an episode, 0 to 1, shape (channels, 1, 1).

    :raises ExtraMissing: Pillow is not installed.
    :raises SessionError: a picture cannot be decoded.
    """
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise ExtraMissing(
            "pictures in LeRobot datasets need the library Pillow",
            hint="pip install 'dexkit[lerobot]'",
        ) from error
    pixels = []
    for i in np.unique(np.linspace(0, len(data) - 1, _SAMPLED).astype(int)).tolist():
        try:
            with Image.open(io.BytesIO(data[i])) as picture:
                small = picture.convert("RGB") if picture.mode != "L" else picture
                small.thumbnail((150, 150))
                array = np.asarray(small, dtype=np.float64) / 255
        except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError) as error:
            raise SessionError(f"{camera}: a picture cannot be decoded: {error}") from error
        pixels.append(array.reshape(-1, 1 if array.ndim == 2 else array.shape[2]))
    found = statistics(np.concatenate(pixels))
    shaped = {k: [[[v]] for v in values] for k, values in found.items() if k != "count"}
    return {**shaped, "count": [len(pixels)]}


def describe(result: Result) -> str:
    """One line about a result."""
    return f"{result.episodes} episodes, {result.frames} frames at {result.fps} Hz"
