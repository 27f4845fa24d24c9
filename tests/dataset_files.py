"""Write small LeRobot datasets of several episodes, as LeRobot lays them out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FPS = 30


def motion(frames: int, phase: float = 0.0, joints: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """State and action of two grippers whose state follows two frames later, rad."""
    t = np.arange(-2, frames)[:, None] / FPS
    q = 2.7 + 2.2 * np.sin((0.9 + 0.2 * np.arange(joints)) * t + phase + np.arange(joints))
    return q[:-2], q[2:]


def write_dataset(
    root: Path,
    version: str,
    episodes: Sequence[tuple[np.ndarray, np.ndarray]],
    names: Sequence[str] = ("kLeftGripper", "kRightGripper"),
    tasks: Sequence[str] = ("take the cup",),
) -> Path:
    """A dataset with (state, action) of each episode, shape (frames, joints) each."""
    (root / "meta").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [len(names)], "names": [list(names)]}
    per_file = version != "v3.0"
    info = {
        "codebase_version": version,
        "robot_type": "Unitree_G1_Dex1",
        "fps": FPS,
        "chunks_size": 1000,
        "total_episodes": len(episodes),
        "total_frames": sum(len(state) for state, _ in episodes),
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        if per_file
        else "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {"observation.state": feature, "action": feature},
    }
    (root / "meta/info.json").write_text(json.dumps(info))
    tables, rows, first = [], [], 0
    for number, (state, action) in enumerate(episodes):
        n = len(state)
        table = {
            "observation.state": state.astype(np.float32).tolist(),
            "action": action.astype(np.float32).tolist(),
            "timestamp": np.arange(n, dtype=np.float32) / np.float32(FPS),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, number),
            "index": np.arange(first, first + n),
            "task_index": np.zeros(n, dtype=int),
        }
        first += n
        tables.append(pa.table(table))
        row: dict[str, Any] = {"episode_index": number, "tasks": list(tasks), "length": n}
        if not per_file:
            row |= {"data/chunk_index": 0, "data/file_index": 0}
        rows.append(row)
    if per_file:
        for number, made in enumerate(tables):
            pq.write_table(made, root / f"data/chunk-000/episode_{number:06d}.parquet")
        (root / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, rows)) + "\n")
        lines = [json.dumps({"task_index": i, "task": t}) for i, t in enumerate(tasks)]
        (root / "meta/tasks.jsonl").write_text("\n".join(lines) + "\n")
    else:
        with pq.ParquetWriter(root / "data/chunk-000/file-000.parquet", tables[0].schema) as file:
            for made in tables:
                file.write_table(made)
        (root / "meta/episodes/chunk-000").mkdir(parents=True)
        listed = pa.Table.from_pylist(rows)
        pq.write_table(listed, root / "meta/episodes/chunk-000/file-000.parquet")
        table = pa.table({"task_index": range(len(tasks)), "task": list(tasks)})
        pq.write_table(table, root / "meta/tasks.parquet")
    return root
