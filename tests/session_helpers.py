"""Sessions of other formats, written as their programs write them and not by dexkit."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner

from dexkit.cli import cli
from dexkit.errors import DexkitError
from dexkit.hand import Side
from dexkit.models import model

__all__ = ["dexkit", "document", "episode", "jpeg", "png", "streamed", "waves", "whole"]

ARM = [
    *("kLeftShoulderPitch", "kLeftShoulderRoll", "kLeftShoulderYaw", "kLeftElbow"),
    *("kLeftWristRoll", "kLeftWristPitch", "kLeftWristyaw"),
]


def dexkit(*arguments: object) -> tuple[int, str]:
    """Exit code and everything printed; of an error, its message and hint."""
    result = CliRunner().invoke(cli, [str(a) for a in arguments], standalone_mode=False)
    if isinstance(result.exception, DexkitError):
        error = result.exception
        return error.exit_code, f"{result.output}{error.message} {error.hint}"
    assert result.exception is None, result.exception
    return int(result.return_value or 0), result.output


def waves(count: int, frames: int, phase: float, low: Any = 0.1, high: Any = 0.9) -> np.ndarray:
    """Smooth positions within limits, float32 values, shape (frames, count)."""
    t = np.arange(frames)[:, None] / 30
    part = 0.5 + 0.45 * np.sin((0.7 + 0.3 * np.arange(count)) * t + phase + 0.2 * t**1.3)
    return (np.asarray(low) + part * (np.asarray(high) - np.asarray(low))).astype(np.float32)


def hand_waves(name: str, side: Side, frames: int, phase: float) -> np.ndarray:
    joints = model(name).joints[side]
    low, high = [j.q_min for j in joints], [j.q_max for j in joints]
    return waves(len(joints), frames, phase, low, high)


def document(
    frames: int = 60,
    hand: str | int = "dex3-1",
    *,
    ends: str = "ee",
    swapped: bool = False,
    cameras: int = 1,
    fps: float = 30.0,
    goal: str = "pick up the cup",
    named: bool = False,
) -> dict[str, Any]:
    """An episode of xr_teleoperate as one object.

    :param hand: a model's name, or the number of joints of another hand.
    :param ends: ``ee`` since v1.0, ``hand`` before.
    :param swapped: each side's states are those of the other one.
    :param named: with the joint names that releases before v1.4 write.
    """
    actions, states = {}, {}
    for i, side in enumerate(Side):
        made = (
            waves(hand, frames, 2.0 * i)
            if isinstance(hand, int)
            else hand_waves(hand, side, frames, 2.0 * i)
        )
        actions[side] = made
        states[side] = np.concatenate([made[:1], made[:1], made[:-2]])  # two frames later
    if swapped:
        states = {Side.LEFT: states[Side.RIGHT], Side.RIGHT: states[Side.LEFT]}
    arms = {side: waves(7, frames, 1.0 + i) for i, side in enumerate(Side)}

    def entry(values: np.ndarray) -> dict[str, Any]:
        return {"qpos": [float(v) for v in values], "qvel": [], "torque": []}

    items = []
    for i in range(frames):
        item: dict[str, Any] = {
            "idx": i,
            "colors": {f"color_{c}": f"colors/{i:06d}_color_{c}.jpg" for c in range(cameras)},
            "depths": {},
        }
        for key, hands in (("states", states), ("actions", actions)):
            group = {f"{s}_arm": entry(arms[s][i]) for s in Side}
            group |= {f"{s}_{ends}": entry(hands[s][i]) for s in Side}
            item[key] = {**group, "body": None if ends == "hand" else {"qpos": []}}
        items.append({**item, "tactiles": None, "audios": None, "sim_state": None})
    names = {f"{s}_{p}": [] for s in Side for p in ("arm", ends)}
    info = {
        "version": "1.0.0",
        "date": "2025-07-08",
        "author": "unitree",
        "image": {"width": 640, "height": 480, "fps": fps},
        "joint_names": {**names, "left_arm": ARM if named else [], "body": []},
    }
    return {"info": info, "text": {"goal": goal, "desc": "", "steps": ""}, "data": items}


def whole(found: dict[str, Any]) -> str:
    """As releases before v1.4 write it, at the end of the episode."""
    return json.dumps(found, indent=4, ensure_ascii=False)


def streamed(found: dict[str, Any], *, end: bool = True) -> str:
    """As v1.4 writes it, item by item; without ``end`` it was interrupted."""
    text = '{\n"info": ' + json.dumps(found["info"], indent=4) + ",\n"
    text += '"text": ' + json.dumps(found["text"], indent=4) + ',\n"data": [\n'
    text += ",\n".join(json.dumps(item) for item in found["data"])  # there with indent=4
    return text + ("\n]\n}" if end else "")


def episode(folder: Path, text: str, pictures: int = 0, frames: int = 0) -> Path:
    """An episode's folder; with so many pictures of ``color_0`` ..."""
    (folder / "colors").mkdir(parents=True)
    (folder / "data.json").write_text(text, encoding="utf-8")
    for c in range(pictures):
        for i in range(frames):
            (folder / "colors" / f"{i:06d}_color_{c}.jpg").write_bytes(jpeg(8, 6, i))
    return folder


def jpeg(width: int, height: int, seed: int = 0) -> bytes:
    """The segments of a JPEG up to its data, which nothing here decodes."""
    size = struct.pack(">BHHB", 8, height, width, 3) + bytes(9)
    return (
        b"\xff\xd8\xff\xe0\x00\x10JFIF"
        + bytes(10)
        + b"\xff\xc0"
        + struct.pack(">H", 2 + len(size))
        + size
        + b"\xff\xda"
        + struct.pack(">I", seed)
        + b"\xff\xd9"
    )


def png(width: int, height: int) -> bytes:
    """A black picture that any program reads."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        crc = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + crc

    rows = b"".join(b"\x00" + bytes(3 * width) for _ in range(height))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )
