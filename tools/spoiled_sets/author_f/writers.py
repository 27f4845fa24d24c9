"""Write episodes as LeRobot datasets v2.0, v2.1 and v3.0, and as xr_teleoperate's task folders."""

from __future__ import annotations

import importlib
import io
import json
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from dexkit.traces.sessions.lerobot_out import TASKS_METADATA
from dexkit.traces.sessions.lerobot_stats import statistics
from tools.spoiled_sets.author_f.motion import (
    ARM,
    FINGERS,
    HANDS,
    Episode,
    Library,
    Plan,
    Rows,
)

__all__ = ["write_lerobot", "write_xr"]

WIDTH, HEIGHT = 96, 72
PLAIN = ("timestamp", "frame_index", "episode_index", "index", "task_index")
FIELDS = {
    "observation.state": "state",
    "action": "action",
    "observation.velocity": "velocity",
    "observation.effort": "effort",
}


def pictures(e: Episode, rows: Rows, seed: int) -> Iterator[NDArray[np.uint8]]:
    """What a camera shows: a bench, two grippers that move with the arms, noise of the sensor."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(60, 190, (6, 8, 3), dtype=np.uint8)
    bench = np.asarray(Image.fromarray(coarse).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC))
    noise = rng.normal(0, 1.5, (16, HEIGHT, WIDTH, 1))
    flicker = rng.normal(0, 0.4, 997)
    for row in rows.tolist():
        # lamps flicker, so that no two pictures of a camera that runs are the same
        frame = bench + noise[row * 7 % 16] + 1.2 * np.sin(2.1 * row) + flicker[row % 997]
        for i, colour in enumerate(((40, 60, 230), (230, 60, 40))):
            x = int(np.clip(e.scene[row, 2 * i], 0, 1) * (WIDTH - 22))
            y = int(np.clip(e.scene[row, 2 * i + 1], 0, 1) * (HEIGHT - 18))
            frame[y : y + 18, x : x + 22] = colour
        yield np.clip(frame, 0, 255).astype(np.uint8)


def write_video(path: Path, frames: Iterable[NDArray[np.uint8]], rate: float) -> None:
    """H.264 in MP4."""
    av: Any = importlib.import_module("av")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        options = {"crf": "21", "g": "10", "preset": "ultrafast"}
        stream = container.add_stream("libx264", rate=round(rate), options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        container.mux(stream.encode())


def encoded(frame: NDArray[np.uint8], form: str) -> bytes:
    """A picture as a file."""
    out = io.BytesIO()
    Image.fromarray(frame).save(out, form, quality=75)
    return out.getvalue()


def columns(plan: Plan, library: Library) -> list[tuple[str, list[str]]]:
    """The parts in the order of a dataset's columns, with the names of their joints."""
    arms = [f"{s}_arm" for s in plan.sides if plan.arms]
    hands = [f"{s}_hand" for s in plan.sides]
    order = arms + hands if plan.style == "unitree" else sorted(arms + hands)
    found = []
    for part in order:
        side, kind = part.split("_")
        if plan.style == "unitree":
            own = ["".join(w.title() for w in n.split("_")) for n in ARM]
            own = own if kind == "arm" else FINGERS[plan.hand][side == "right"]
            found.append((part, [f"k{side.title()}{n}" for n in own]))
            continue
        names = [f"{side}_{n}" for n in ARM]
        if kind == "hand":
            names = [n for n in library.names[plan.hand]["action"] if n.startswith(side)]
        found.append((part, [f"{n}.pos" for n in names] if plan.style == "other" else names))
    return found


def write_lerobot(root: Path, plan: Plan, library: Library, episodes: Sequence[Episode]) -> None:
    """A dataset of the plan's version."""
    version = plan.form.removeprefix("lerobot-")
    v3 = version == "v3.0"
    parts = columns(plan, library)
    known = {k: v for k, v in FIELDS.items() if v in ("state", "action") or v in plan.carries}
    names = [n for _, own in parts for n in own]
    features: dict[str, Any] = {
        k: {
            "dtype": "float32",
            "shape": [len(names)],
            "names": [names] if plan.style == "unitree" else names,
        }
        for k in known
    }
    if "pressure" in plan.carries:
        elements = library.names[plan.hand]["observation.pressure"]
        shape = {"dtype": "float32", "shape": [len(elements)], "names": elements}
        features["observation.pressure"] = shape
    embedded = plan.cameras and plan.fps == 15
    for camera in plan.cameras:
        features[f"observation.images.{camera}"] = {
            "dtype": "image" if embedded else "video",
            "shape": [HEIGHT, WIDTH, 3],
            "names": ["height", "width", "channel"],
            "info": {"video.fps": float(plan.fps), "video.codec": "h264", "has_audio": False},
        }
    for name in PLAIN:
        dtype = "float32" if name == "timestamp" else "int64"
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    tasks: dict[str, int] = {}
    for e in episodes:
        if e.task != "\0":
            tasks.setdefault(e.task, len(tasks))
    rows: list[dict[str, Any]] = []
    stats: list[dict[str, Any]] = []
    whole: dict[str, list[NDArray[Any]]] = {}
    tables: list[tuple[int, Any]] = []
    films: dict[str, list[tuple[Episode, Rows, int]]] = {c: [] for c in plan.cameras}
    start = 0
    for number, e in enumerate(episodes):
        n = len(e)
        vectors: dict[str, NDArray[Any]] = {
            k: np.concatenate([getattr(e.parts[p], v) for p, _ in parts], axis=1).astype(np.float32)
            for k, v in known.items()
        }
        if "pressure" in plan.carries:
            both = [e.parts[f"{s}_hand"].pressure for s in plan.sides]
            vectors["observation.pressure"] = np.concatenate(both, axis=1).astype(np.float32)
        plain: dict[str, NDArray[Any]] = {
            "timestamp": e.stamps.astype(np.float32),
            "frame_index": e.numbers.astype(np.int64),
            "episode_index": np.full(n, number),
            "index": np.arange(start, start + n),
            "task_index": np.full(n, tasks.get(e.task, 99)),
        }
        own = {k: _statistics(v) for k, v in (vectors | plain).items()}
        for k in ("observation.state", "action"):
            if e.false_stats:
                for name, value in own[k].items():
                    if name != "count":
                        own[k][name] = [v * e.false_stats for v in value]
        arrays: dict[str, Any] = {}
        for k, v in vectors.items():
            flat = pa.array(v.reshape(-1), type=pa.float32())
            arrays[k] = pa.FixedSizeListArray.from_arrays(flat, v.shape[1])
        for i, camera in enumerate(plan.cameras):
            seen = e.seen[camera]
            if seen is None:
                continue
            key = f"observation.images.{camera}"
            seed = zlib.crc32(f"{plan.folder}{i}".encode())
            some = seen[np.unique(np.linspace(0, len(seen) - 1, 8).astype(int))]
            own[key] = _picture_statistics(list(pictures(e, some, seed)))
            if embedded:
                kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
                data = [
                    {"bytes": encoded(frame, "jpeg"), "path": f"{k}.jpg"}
                    for k, frame in enumerate(pictures(e, seen, seed))
                ]
                arrays[key] = pa.array(data, type=kind)
            elif v3:
                films[camera].append((e, seen, seed))
            else:
                path = root / f"videos/chunk-000/{key}/episode_{number:06d}.mp4"
                write_video(path, pictures(e, seen, seed), e.video_rate or plan.fps)
        arrays |= {k: pa.array(v) for k, v in plain.items()}
        table = pa.table(arrays)
        for k, v in (vectors | plain).items():
            whole.setdefault(k, []).append(v)
        if v3:
            tables.append((int(e.broken == "half"), table))
        elif e.broken != "gone":
            path = root / f"data/chunk-000/episode_{number:06d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(table.slice(0, n - 1) if e.broken == "row" else table, str(path))
            if e.broken == "half":
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        row: dict[str, Any] = {"episode_index": number}
        row["tasks"] = [e.task] if e.task in tasks else []
        row["length"] = n
        if v3:
            row |= {"data/chunk_index": 0, "data/file_index": int(e.broken == "half")}
            row |= {"dataset_from_index": start, "dataset_to_index": start + n}
            row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
            for camera, film in films.items() if not embedded else ():
                first = sum(len(seen) for _, seen, _ in film[:-1]) / plan.fps
                key = f"videos/observation.images.{camera}"
                row |= {f"{key}/chunk_index": 0, f"{key}/file_index": 0}
                row |= {f"{key}/from_timestamp": first, f"{key}/to_timestamp": first + n / plan.fps}
            row |= {f"stats/{k}/{s}": v for k, found in own.items() for s, v in found.items()}
        rows.append(row)
        stats.append({"episode_index": number, "stats": own})
        start += n
    meta = root / "meta"
    meta.mkdir(parents=True, exist_ok=True)
    total = {k: _statistics(np.concatenate(v)) for k, v in whole.items()}
    info: dict[str, Any] = {
        "codebase_version": version,
        "robot_type": _robot(plan),
        "total_episodes": len(episodes),
        "total_frames": start,
        "total_tasks": len(tasks),
        "chunks_size": 1000,
        "fps": plan.fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": None,
        "features": features,
    }
    if v3:
        info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        if plan.cameras and not embedded:
            info["video_path"] = (
                "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
            )
        for index in sorted({i for i, _ in tables}):
            path = root / f"data/chunk-000/file-{index:03d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.concat_tables([t for i, t in tables if i == index]), str(path))
            if index:
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        for camera, film in films.items():
            if film:
                path = root / f"videos/observation.images.{camera}/chunk-000/file-000.mp4"
                write_video(path, (f for shot in film for f in pictures(*shot)), plan.fps)
        (meta / "episodes/chunk-000").mkdir(parents=True)
        path = meta / "episodes/chunk-000/file-000.parquet"
        pq.write_table(pa.Table.from_pylist(rows), str(path))
        listed = pa.table({"task_index": list(tasks.values()), "task": list(tasks)})
        listed = listed.replace_schema_metadata(TASKS_METADATA)
        pq.write_table(listed, str(meta / "tasks.parquet"))
    else:
        info |= {"total_videos": len(plan.cameras) * len(episodes), "total_chunks": 1}
        if plan.cameras:
            info["video_path"] = (
                "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
            )
        _lines(meta / "episodes.jsonl", rows)
        _lines(meta / "tasks.jsonl", [{"task_index": i, "task": t} for t, i in tasks.items()])
        if version == "v2.1":
            _lines(meta / "episodes_stats.jsonl", stats)
    if version != "v2.1":
        (meta / "stats.json").write_text(json.dumps(total, indent=4))
    (meta / "info.json").write_text(json.dumps(info, indent=4))


def _robot(plan: Plan) -> str:
    if plan.style == "unitree":
        kind = {"dex1": "Dex1", "dex3": "Dex3", "brainco": "Brainco"}.get(plan.hand, "Inspire")
        return f"Unitree_G1_{kind}"
    return HANDS[plan.hand].model if plan.style == "dexkit" else "bimanual_follower"


def _lines(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(r) + "\n" for r in rows))


def _statistics(values: NDArray[Any]) -> dict[str, list[Any]]:
    """As dexkit's, some columns at a time: touch has thousands."""
    if values.ndim == 1:
        return statistics(values)
    blocks = [statistics(values[:, i : i + 200]) for i in range(0, values.shape[1], 200)]
    names = [k for k in blocks[0] if k != "count"]
    return {k: [v for b in blocks for v in b[k]] for k in names} | {"count": blocks[0]["count"]}


def _picture_statistics(frames: Sequence[NDArray[np.uint8]]) -> dict[str, Any]:
    found = statistics(np.stack(frames).reshape(-1, 3) / 255)
    shaped = {k: [[[v]] for v in t] for k, t in found.items() if k != "count"}
    return shaped | {"count": [len(frames)]}


def write_xr(folder: Path, plan: Plan, library: Library, e: Episode) -> None:
    """An episode of a task folder; the form is ``xr-v0.5``, ``xr-v1.1`` or ``xr-v1.3``."""
    version = plan.form.removeprefix("xr-")
    suffix = "hand" if version == "v0.5" else "ee"
    named = {p: list(names) for p, names in columns(plan, library)}
    info = {
        "version": "1.0.0",
        "date": "2026-03-14",
        "author": "unitree",
        "image": {"width": 640, "height": 480, "fps": plan.fps},
        "depth": {"width": 640, "height": 480, "fps": plan.fps},
        "audio": {"sample_rate": 16000, "channels": 1, "format": "PCM", "bits": 16},
        "joint_names": {
            p.replace("_hand", f"_{suffix}"): [] if version == "v1.3" else names
            for p, names in named.items()
        },
        "tactile_names": {f"left_{suffix}": [], f"right_{suffix}": []},
        "sim_state": "",
    }
    for kind in ("colors", "depths", "audios"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    items: list[dict[str, Any]] = []
    body: dict[str, list[float]] | None = None if version == "v0.5" else {"qpos": []}
    # states are what came as float32; actions were calculated
    for k in range(len(e)):
        item: dict[str, Any] = {"idx": int(e.numbers[k]), "colors": {}, "depths": {}}
        if e.time_ns:
            item["timestamp_ns"] = 1_773_480_000_000_000_000 + round(float(e.stamps[k]) * 1e9)
        for i, camera in enumerate(plan.cameras):
            seen = e.seen[camera]
            if seen is not None and k < len(seen):
                item["colors"][camera] = f"colors/{int(e.numbers[k]):06d}_color_{i}.jpg"
        for key, name in (("states", "state"), ("actions", "action")):
            item[key] = {}
            for part, p in e.parts.items():
                row = getattr(p, name)[k]
                values = row.astype(np.float32).tolist() if name == "state" else row.tolist()
                if e.broken == "short" and k > len(e) // 2 and part == "left_arm":
                    values = values[:-1]
                own = {"qpos": values, "qvel": [], "torque": []}
                item[key][part.replace("_hand", f"_{suffix}")] = own
            item[key]["body"] = body
        item |= {"tactiles": None, "audios": None, "sim_state": None}
        items.append(item)
    for i, camera in enumerate(plan.cameras):
        seen = e.seen[camera]
        if seen is None:
            continue
        seed = zlib.crc32(f"{plan.folder}{i}".encode())
        for k, frame in enumerate(pictures(e, seen, seed)):
            path = folder / f"colors/{int(e.numbers[k]):06d}_color_{i}.jpg"
            path.write_bytes(encoded(frame, "jpeg"))
    text = {"goal": e.task, "desc": e.task and f"{e.task}, with both hands.", "steps": ""}
    if e.broken == "latin":
        text["goal"] = "Löffel auf den Tisch legen, für Übung"
    if e.broken == "empty":
        items = []
    if version == "v1.3":
        head = [json.dumps(v, indent=4, ensure_ascii=False) for v in (info, text)]
        frames = ",\n".join(json.dumps(i, ensure_ascii=False) for i in items)
        document = f'{{\n"info": {head[0]},\n"text": {head[1]},\n"data": [\n{frames}\n]\n}}'
    else:
        whole = {"info": info, "text": text, "data": items}
        document = json.dumps(whole, ensure_ascii=False, indent=4)
    data = document.encode("latin-1" if e.broken == "latin" else "utf-8")
    if e.broken == "cut":
        data = data[: int(len(data) * 0.55)]
    (folder / "data.json").write_bytes(data)
