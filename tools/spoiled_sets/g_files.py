"""Motions that :mod:`author_g` spoils, and files of LeRobot and xr_teleoperate with them."""

from __future__ import annotations

import importlib
import io
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.traces import sample_path
from dexkit.traces.reader import open_trace
from dexkit.traces.sessions.lerobot_out import export_dataset
from tools.spoiled_sets import lerobot_files
from tools.spoiled_sets.lerobot_files import SIDES, SIZE, Author, row_of

Floats = NDArray[np.float64]
START_NS = 1_793_000_000_000_000_000
ARM = ("ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow",
       "WristRoll", "WristPitch", "WristYaw")  # fmt: skip
_INSPIRE = ("Pinky", "Ring", "Middle", "Index", "ThumbBend", "ThumbRotation")
JOINTS = {
    "dex1-1": ("Gripper",),
    "dex3-1": ("Thumb0", "Thumb1", "Thumb2", "Middle0", "Middle1", "Index0", "Index1"),
    "dex5-1": tuple(
        f"{'Roll' if j == 1 else 'Pitch'}_{f}{j}" for f in (2, 3, 4, 5) for j in (1, 2, 3, 4)
    ),
    "brainco-revo2": ("Thumb", "ThumbAux", "Index", "Middle", "Ring", "Pinky"),
    "inspire-dfx": _INSPIRE,
    "inspire-ftp": _INSPIRE,
}
TOUCH = ("pinky_tip_4", "ring_tip_4", "middle_tip_4", "index_tip_4", "thumb_tip_4")


@dataclass
class Track:
    """Joints of a part, each (frames, joints): rad or 0 to 1, rad/s or 1/s, N·m or share."""

    action: Floats
    state: Floats
    velocity: Floats
    effort: Floats


@dataclass
class Take:
    """One episode.

    :param touch: by side (frames, 5), counts.
    :param seen: where pictures show the two hands, (frames, 6): x, y, radius of each.
    :param shown: by camera, which frame's picture stands at each place of the stream.
    :param number: what the frames say of their number.
    :param done: what the writers do to this episode.
    """

    tracks: dict[str, Track]
    touch: dict[str, Floats]
    seen: Floats
    shown: dict[str, NDArray[np.int64]]
    number: NDArray[np.int64]
    task: str
    done: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.number)


@dataclass(frozen=True)
class Set:
    """One dataset or task folder.

    :param form: LeRobot v2.0, v2.1, v3.0, or xr v0.5, v1.1, v1.4.
    :param names: unitree (unitree_lerobot's), dexkit, other.
    :param columns: of state, velocity, effort, pressure.
    :param gone: what is broken of the whole: info (meta/info.json), half (of the data file).
    """

    name: str
    form: str
    model: str
    fps: int
    names: str = "unitree"
    cameras: tuple[str, ...] = ()
    columns: tuple[str, ...] = ("state",)
    parts: tuple[str, ...] = ("left_arm", "right_arm", "left_hand", "right_hand")
    task: str = "Put the object into the box."
    timed: bool = False
    gone: str = ""
    stamp: float = 0


Rng = np.random.Generator
RATE = 120  # steps of the model a second
SAMPLES = {
    "dex1-1": "dex1_pick_place",
    "dex3-1": "dex3_pinch",
    "dex5-1": "dex5_synthetic",
    "brainco-revo2": "brainco_grip",
    "inspire-dfx": "inspire_dfx_grip",
    "inspire-ftp": "inspire_ftp_grip",
}
# N·m a rad, or share of the force a unit of travel, of action minus state
STIFFNESS = {"dex1-1": 0.9, "dex3-1": 1.5, "dex5-1": 1.1, "brainco-revo2": 2.2, "inspire-ftp": 2.4}
# fastest motion of a hand in full strokes a second
FASTEST = {"dex1-1": 1.9, "dex3-1": 3.5, "dex5-1": 2.4, "brainco-revo2": 1.9, "inspire-ftp": 1.8}
HOME = np.array([0.15, 0.2, 0.05, 0.55, 0.0, 0.0, 0.0])
REACH = np.array([0.45, 0.22, 0.3, 0.42, 0.3, 0.22, 0.24])
SIGNS = {"left": np.ones(7), "right": np.array([1, -1, -1, 1, -1, 1, -1.0])}


# -- motion -----------------------------------------------------------------------------------


@cache
def sampled(name: str) -> dict[str, Floats]:
    """A shipped sample as dexkit exports it at 60 frames a second, by feature."""
    parquet: Any = importlib.import_module("pyarrow.parquet")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "set"
        export_dataset([open_trace(sample_path(name))], out, fps=60)
        table = parquet.read_table(str(out / "data/chunk-000/file-000.parquet"))
        first = np.array(table["episode_index"].to_pylist()) == 0
        keys = [k for k in table.column_names if k == "action" or k.startswith("observation")]
        return {k: np.array(table[k].to_pylist(), dtype=float)[first] for k in keys}


@cache
def strokes(model: str, side: str) -> tuple[Floats, ...]:
    """Strokes from open to closed in the sample's commands, each (61, joints)."""
    both = sampled(SAMPLES[model])["action"]
    n = both.shape[1] // 2
    table = both[:, :n] if side == "left" else both[:, n:]
    if model == "dex1-1":  # it begins closed
        rest = np.array([5.4])
    elif model == "dex3-1":
        rest = table[200]
    elif model.startswith("inspire"):
        rest = table.max(axis=0)
    else:
        rest = np.minimum(table[0], table[-1])
    wide = np.ptp(table, axis=0)
    way = (np.abs(table - rest) / np.where(wide > 0.05, wide, np.inf)).sum(axis=1)
    way = way / way.max()
    found = []
    low = None
    for i in range(1, len(way)):
        if way[i] < 0.12:
            low = i
        elif low is not None and way[i] >= 0.72 and way[i] >= way[i : i + 12].max() - 1e-3:
            piece = np.concatenate([rest[None], table[low : i + 1]])
            at = np.linspace(0, len(piece) - 1, 61)
            path = [np.interp(at, np.arange(len(piece)), c) for c in piece.T]
            padded = [np.concatenate([np.full(9, c[0]), c, np.full(9, c[-1])]) for c in path]
            smooth = [np.convolve(c, np.ones(19) / 19, "valid") for c in padded]
            for c, d in zip(smooth, path, strict=True):
                c += np.interp(np.arange(61), [0, 60], [d[0] - c[0], d[-1] - c[-1]])
            found.append(np.stack(smooth, axis=1))
            low = None
    return tuple(found)


@dataclass
class Side:
    """What one arm and hand are to do.

    :param arm: moves of the arm: begin, end, goal (7).
    :param hand: moves of the hand: begin, end, closure.
    :param held: objects: begin, end, closure at which the fingers meet it.
    """

    arm: list[tuple[float, float, Floats]]
    hand: list[tuple[float, float, float]]
    held: list[tuple[float, float, float]]


# A gripper's stroke is long: its operators take more time.
_LONGER = {"dex1-1": 0.25}


def plan(rng: Rng, seconds: float, style: dict[str, Any], side: str, model: str) -> Side:
    """Reach, grasp, carry, put down, return, again and again."""
    pace = style.get("pace", 1.0)
    moves, grips, held = [], [], []
    arm = style.get("arms", "both") in (side, "both")
    hand = style.get("hands", "both") in (side, "both")
    size = style.get("size", 0.62) + rng.uniform(-0.06, 0.06)
    t = style.get("start", 0.5) + rng.uniform(0, 0.35) + (0.7 if side == "left" else 0) / pace

    def go(length: float, goal: Floats) -> float:
        if arm:
            moves.append((t, t + length, goal * SIGNS[side]))
        return length

    last = seconds - style.get("end", 0.5)
    while t < last - 3.0 / pace:
        far = HOME + rng.normal(0, 1, 7) * REACH
        far[3] = abs(far[3] - 0.4) + 0.35
        t += go(rng.uniform(0.8, 1.5) / pace, far) * 0.92
        close = (rng.uniform(0.45, 0.9) + _LONGER.get(model, 0.0)) / pace
        strong = style.get("strong", 1.0) * rng.uniform(0.93, 1.0)
        begin = t
        if hand and not style.get("only_opens"):
            grips.append((t, t + close, strong))
        t += close + rng.uniform(0.1, 0.3)
        for _ in range(style.get("carries", 1)):
            t += go(rng.uniform(0.7, 1.4) / pace, HOME + rng.normal(0, 1, 7) * REACH)
        t += style.get("hold", rng.uniform(0.2, 0.7)) / pace
        drop = style.get("drop") == side
        if hand and style.get("object", True) and style.get("nothing") != side:
            finish = begin + close + (t - begin - close) * rng.uniform(0.35, 0.5) if drop else t
            held.append((begin, finish if drop else t + 9.0, size))
        if hand:
            opened = (rng.uniform(0.35, 0.7) + _LONGER.get(model, 0.0)) / pace
            back = style.get("half_open", 0.0) * rng.uniform(0.6, 1.3)
            grips.append((t, t + opened, back))
            if held and not drop and held[-1][0] == begin:
                # it is out of reach when the last finger has let go
                gone = opened + 0.4 + style.get("roll", 0.1) + style.get("lag", 0.0)
                held[-1] = (begin, t + gone, size)
            t += opened
        t += go(rng.uniform(0.7, 1.2) / pace, HOME + rng.normal(0, 0.25, 7) * REACH)
        t += rng.uniform(0.05, 0.3) / pace
    return Side(moves, grips, held)


def ease(x: Floats) -> Floats:
    """The way of a minimum-jerk motion, 0 to 1."""
    x = np.clip(x, 0, 1)
    return x**3 * (10 - 15 * x + 6 * x * x)


def wobble(rng: Rng, n: int, joints: int, low: float, high: float) -> Floats:
    """Motion without aim between two frequencies, of size 1, (n, joints)."""
    t = np.arange(n)[:, None] / RATE
    found = np.zeros((n, joints))
    for _ in range(5):
        f = rng.uniform(low, high, joints)
        found += np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi, joints))
    return found / 1.6


def follow_arm(rng: Rng, goal: Floats, style: dict[str, Any]) -> Floats:
    """An arm's joints after delay, with overshoot and the sag of its weight."""
    delay = round(style.get("delay", rng.uniform(0.015, 0.05)) * RATE)
    wn = style.get("wn", rng.uniform(15, 24))
    damp = rng.uniform(0.55, 0.85, 7)
    sag = np.array([0.022, 0.008, 0.003, 0.026, 0.002, 0.006, 0.002]) * style.get("sag", 1.0)
    late = np.concatenate([np.repeat(goal[:1], delay, axis=0), goal])[: len(goal)]
    x, v = late[0] + sag * np.cos(late[0]), np.zeros(7)
    out = np.empty_like(goal)
    for i in range(len(goal)):
        v = v + (wn * wn * (late[i] + sag * np.cos(x) - x) - 2 * damp * wn * v) / RATE
        x = x + v / RATE
        out[i] = x
    return out


def follow_hand(
    rng: Rng, goal: Floats, stop: Floats, rest: Floats, wide: Floats, style: dict[str, Any],
    fastest: float,
) -> Floats:  # fmt: skip
    """A hand's joints after delay, at limited speed, up to the object that it meets.

    :param stop: closure (n,) at which an object stops the fingers; inf without one.
    :param wide: from rest to closed, with its sign, by joint.
    """
    delay = round(style.get("lag", rng.uniform(0.02, 0.05)) * RATE)
    slow = style.get("tau", rng.uniform(0.03, 0.06))
    soft = style.get("soft", 0.03)
    late = np.concatenate([np.repeat(goal[:1], delay, axis=0), goal])[: len(goal)]
    moves = np.abs(wide) > 0.08
    scale = np.where(moves, wide, 1.0)
    want = (late - rest) / scale
    fingers = rng.uniform(-0.05, 0.05, len(wide))
    x = want[0]
    limit = fastest / RATE * style.get("speed", 1.0)
    out = np.empty_like(goal)
    for i in range(len(goal)):
        aim = want[i]
        if np.isfinite(stop[i]):
            wall = stop[i] + fingers
            aim = np.where(moves & (aim > wall), wall + soft * (aim - wall), aim)
        x = x + np.clip((aim - x) / (slow * RATE), -limit, limit)
        out[i] = rest + x * scale
    return out


def make(made: Set, style: dict[str, Any], seed: int, alike: int = 0) -> Take:
    """One good episode.

    :param alike: not 0 for another go at the same motion.
    """
    rng = np.random.default_rng(seed)
    own = np.random.default_rng(seed * 1000 + alike + 17)
    hz = style.get("hz", made.fps)
    seconds = style.get("seconds", float(np.round(rng.uniform(7, 13), 2)))
    n = round((seconds + 0.2) * RATE)
    t = np.arange(n) / RATE
    when = t.copy()  # time in the plan
    for at, length in style.get("pauses", ()):
        when = np.where(when < at, when, np.maximum(at, when - length))
    frames = np.round(np.arange(round(seconds * hz)) / hz * RATE).astype(int)
    tracks, touch, seen, spans, until = {}, {}, [], {}, 0.0
    for side in SIDES:
        todo = plan(rng, seconds - sum(x for _, x in style.get("pauses", ())), style, side,
                    made.model)  # fmt: skip
        if alike:
            todo = _again(own, todo)
        spans[side] = todo.held
        if any(f"{side}_" in p for p in made.parts):
            until = max([until, *(b for _, b, _ in todo.arm), *(b for _, b, _ in todo.hand)])
        goal = np.tile(HOME * SIGNS[side] + rng.normal(0, 0.06, 7), (n, 1))
        for begin, end, to in todo.arm:
            goal += (to - goal[-1]) * ease((when - begin) / (end - begin))[:, None]
        still = style.get("arms", "both") not in (side, "both") and style.get("dead_still")
        shake = 0.0 if still else style.get("tremor", 1.0)
        goal += shake * (0.0022 * wobble(own, n, 7, 4, 9) + 0.004 * wobble(own, n, 7, 0.1, 0.5))
        arm = follow_arm(own, goal, style)
        hand, action, effort, closed = _hand(made, style, rng, own, todo, when, side)
        noise = style.get("noise", 1.0)
        for kind, a, x in (("arm", goal, arm), ("hand", action, hand)):
            unit = 0.0005 if kind == "arm" else 0.0008
            e = effort if kind == "hand" else 14.0 * (a - x)
            read = x[frames] + own.normal(0, unit * noise, x[frames].shape)
            if kind == "hand" and made.model not in ("dex1-1", "dex3-1", "dex5-1"):
                read = np.clip(read, 0, 1)
            step = style.get("step", {}).get(kind, 0.0002 if kind == "arm" else 0.001)
            v = np.gradient(x, 1 / RATE, axis=0)[frames]
            tracks[f"{side}_{kind}"] = Track(
                a[frames].copy(),
                np.round(read / step) * step,
                v + own.normal(0, 0.01, v.shape),
                e[frames] + own.normal(0, 0.008, e[frames].shape),
            )
        pressed = np.clip(np.abs(effort[frames]), 0, None) * closed[frames, None]
        fingers = np.resize(np.arange(effort.shape[1]), 5)
        touch[side] = np.round(np.clip(
            700 * pressed[:, fingers] + own.normal(0, 3, (len(frames), 5)), 0, 4095
        ))  # fmt: skip
        across = np.tanh(0.8 * (arm[:, 2] + 0.6 * arm[:, 1]))
        base = 30 if side == "left" else 64
        y = 38 + 26 * np.tanh(0.9 * (arm[:, 0] - 0.5 * (arm[:, 3] - 0.6)))
        stroke = 5.4 if made.model == "dex1-1" else 1.0
        r = 9 - 4 * np.clip(np.abs(hand - hand[0]).mean(axis=1) / stroke, 0, 1)
        seen.append(np.stack([base + 24 * across, y, r], axis=1)[frames])
    take = Take(
        {p: tracks[p] for p in made.parts},
        touch,
        np.concatenate(seen, axis=1),
        {c: np.arange(len(frames)) for c in made.cameras},
        np.arange(len(frames)),
        style.get("task", made.task),
    )
    take.done |= {"spans": spans, "until": until}
    if hz != made.fps:
        take.done["hz"] = hz
    for track in take.tracks.values():
        if style.get("mode") == "equal":
            track.action = track.state.copy()
        elif style.get("mode") == "next":
            track.action = np.concatenate([track.state[1:], track.state[-1:]])
    return take


def _again(rng: Rng, todo: Side) -> Side:
    shift, pace = rng.uniform(-0.12, 0.2), rng.uniform(0.95, 1.04)
    return Side(
        [(a * pace + shift, b * pace + shift, g + rng.normal(0, 0.05, 7)) for a, b, g in todo.arm],
        [(a * pace + shift, b * pace + shift, c * rng.uniform(0.96, 1)) for a, b, c in todo.hand],
        [(a * pace + shift, b * pace + shift, c) for a, b, c in todo.held],
    )


def _hand(
    made: Set, style: dict[str, Any], rng: Rng, own: Rng, todo: Side, when: Floats, side: str
) -> tuple[Floats, Floats, Floats, Floats]:
    """State, action, effort (n, joints) and whether it holds something (n,)."""
    model = made.model
    known = strokes(model, side)
    path = known[style.get("stroke", int(rng.integers(len(known))))]
    rest = path[0]
    n = len(when)
    level = np.full(n, style.get("closed_first", 0.0))
    for begin, end, to in todo.hand:
        x = (when - begin) / (end - begin)
        level += (to - level[-1]) * (0.5 * ease(x) + 0.5 * np.clip(x, 0, 1))
    joints = path.shape[1]
    action = np.empty((n, joints))
    late = (rng.uniform(0, style.get("roll", 0.1), joints) * RATE).astype(int)
    if style.get("roll", 0) > 0.2:  # one finger after another
        late = np.sort(late)[:: -1 if side == "left" else 1]
    strength = rng.uniform(1 - style.get("fingers", 0.14), 1.0, joints) * style.get("amp", 1.0)
    for j in range(joints):
        own_level = np.concatenate([np.full(late[j], level[0]), level])[:n]
        action[:, j] = np.interp(own_level * 60, np.arange(61), path[:, j])
    action = rest + (action - rest) * strength
    wide = (path[-1] - rest) * strength
    jitter = 0.0035 * style.get("tremor", 1.0) * wobble(own, n, joints, 1.5, 7) * np.abs(wide)
    if style.get("hands", "both") not in (side, "both"):
        jitter *= 0.15
    low, high = np.minimum(rest, rest + wide), np.maximum(rest, rest + wide)
    if model in ("brainco-revo2", "inspire-dfx", "inspire-ftp"):
        low, high = np.zeros(joints), np.ones(joints)
    action = np.clip(action + jitter, low, high)
    stop = np.full(n, np.inf)
    for begin, end, size in todo.held:
        stop[(when >= begin) & (when < end)] = size
    fastest = FASTEST.get(model, 1.8)
    hand = follow_hand(own, action, stop, rest, wide, style, fastest)
    hand = hand + style.get("offset", 0.0) * np.abs(wide)
    effort = STIFFNESS.get(model, 1.0) * (action - hand)
    moves = np.where(np.abs(wide) > 0.08, wide, 1.0)
    beyond = ((action - hand) / moves).mean(axis=1)
    return hand, action, effort, (np.isfinite(stop) & (beyond > 0.02)).astype(float)


def piece(made: Set, style: dict[str, Any], seed: int) -> Take:
    """Pieces of samples of the gripper, actions and states as they were, warped in time.

    Each side has a piece of its own unless ``style`` names the one of both.
    """
    rng = np.random.default_rng(seed)
    names = ("dex1_pick_place", "dex1_idle_then_startle", "dex1_legacy_v1_1", "dex1_hand_dropout")
    hz = style.get("hz", made.fps)
    seconds = style.get("seconds", float(rng.uniform(7, 11)))
    tracks = {}
    for s, side in enumerate(SIDES):
        name = style.get("from", names[int(rng.integers(4))])
        source = sampled(name)
        low = {"dex1_idle_then_startle": 7.5, "dex1_hand_dropout": 0.8}.get(name, 1.2)
        whole = len(source["action"]) / 60 - 0.2
        warp = style.get("warp", float(rng.uniform(0.85, 1.6)))
        warp = max(warp, seconds / (whole - low))
        begin = style.get("begin", float(rng.uniform(low, max(low, whole - seconds / warp))))
        column = s if "from" in style else int(rng.integers(2))
        t = np.arange(round(seconds * hz)) / hz
        sway, turn = float(rng.uniform(0.1, 0.3)), 2 * np.pi / float(rng.uniform(4, 7))
        share, phase = float(rng.uniform(0.8, 1.0)), float(rng.uniform(0, 2 * np.pi))
        if "from" in style:
            sway, share = 0.0, 1.0
        # no operator repeats a stroke at the same pace and of the same width
        at = 60 * (begin + t / warp + sway * (np.sin(turn * t + phase) - np.sin(phase)))
        pace = (1 / warp + sway * turn * np.cos(turn * t + phase))[:, None]
        grid = np.arange(len(source["action"]))
        get = {k: np.interp(at, grid, v[:, column])[:, None] for k, v in source.items()}
        action, state = (5.4 - share * (5.4 - get[k]) for k in ("action", "observation.state"))
        tracks[f"{side}_hand"] = Track(
            action,
            np.round((state + rng.normal(0, 0.0015, state.shape)) * 1000) / 1000,
            get["observation.velocity"] * share * pace + rng.normal(0, 0.012, state.shape),
            get["observation.effort"] + rng.normal(0, 0.006, state.shape),
        )
    n = len(at)
    take = Take(tracks, {}, np.zeros((n, 6)), {}, np.arange(n), made.task)
    if hz != made.fps:
        take.done["hz"] = hz
    return take


# -- pictures ---------------------------------------------------------------------------------

_ROWS, _COLUMNS = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(np.float32)
_WALLS = [
    np.stack([np.full_like(_ROWS, 150 - 20 * i), 140 + 0.3 * _ROWS, 110 + 0.5 * _COLUMNS], axis=-1)
    - 45 * (((_COLUMNS // 16 + i) % 3 == 0) | (_ROWS > 62))[..., None]
    for i in range(4)
]
_GRAIN = np.random.default_rng(31).normal(0, 2, (16, SIZE[1], SIZE[0], 1)).astype(np.float32)
_TINTS = np.array([[40, 40, 45], [215, 215, 205]], dtype=np.float32)


def draw(take: Take, frame: int, which: int) -> NDArray[np.uint8]:
    """A picture of two hands before a wall as they were at a frame, (72, 96, 3)."""
    picture = _WALLS[which].copy()
    for tint, (x, y, r) in zip(_TINTS, take.seen[frame].reshape(2, 3), strict=True):
        if which:  # a second camera stands at the side
            x, y, r = SIZE[0] - 0.7 * x - 8, 0.8 * y + 6, 0.9 * r
        left, right = max(0, int(x - r - 3)), max(0, int(x + r + 4))
        top, low = max(0, int(y - r - 3)), max(0, int(y + r + 4))
        box = (slice(top, low), slice(left, right))
        away = np.maximum(
            np.abs(_COLUMNS[box] - np.float32(x)), np.abs(_ROWS[box] - np.float32(y)) * 0.8
        )
        near = np.clip(np.float32(r) + 1 - away, 0, 1)[..., None]
        picture[box] = picture[box] * (1 - near) + tint * near
    found: NDArray[np.uint8] = np.clip(picture + _GRAIN[frame % 16], 0, 255).astype(np.uint8)
    return found


# -- LeRobot ----------------------------------------------------------------------------------

AUTHOR = Author(
    joints=JOINTS.__getitem__,
    arm=ARM,
    touch=TOUCH,
    draw=draw,
    video={"crf": "27", "g": "10"},
    pictures=12,
    robot="bi_gripper",
)


def write_lerobot(root: Path, made: Set, takes: Sequence[Take]) -> None:
    """Write a dataset, and break it as a whole where it is to be broken."""
    lerobot_files.write_lerobot(AUTHOR, root, made, takes)
    if made.gone == "info":
        (root / "meta/info.json").unlink()
    elif made.gone == "half":
        path = root / "data/chunk-000/file-000.parquet"
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


# -- xr_teleoperate ---------------------------------------------------------------------------


def write_xr(root: Path, made: Set, takes: Sequence[Take]) -> None:
    """Write a task folder as xr_teleoperate of this release does."""
    images: Any = importlib.import_module("PIL.Image")
    old, newest = made.form.endswith("v0.5"), made.form.endswith("v1.4")
    named = {p: p if old else p.replace("hand", "ee") for p in made.parts}
    jitter = np.random.default_rng(len(takes))
    for e, take in enumerate(takes):
        folder = root / f"episode_{e:04d}"
        for kind in ("colors", "depths", "audios"):
            (folder / kind).mkdir(parents=True)
        items: list[dict[str, Any]] = []
        for i in range(len(take)):
            number = int(take.number[i])
            item: dict[str, Any] = {"idx": number, "colors": {}, "depths": {}}
            if made.timed:
                passed = number / take.done.get("hz", made.fps) + jitter.uniform(0, 2e-3)
                item["timestamp_ns"] = START_NS + round(passed * 1e9)
            for which, name in enumerate(made.cameras):
                shown = take.shown[name]
                path = f"colors/{number:06d}_{name}.jpg"
                item["colors"][name] = path
                if i >= len(shown) or take.done.get("no camera") == name:
                    continue
                data = io.BytesIO()
                images.fromarray(draw(take, int(shown[i]), which)).save(data, "JPEG", quality=80)
                (folder / path).write_bytes(data.getvalue())
            for key in ("states", "actions"):
                item[key] = {}
                for part, t in take.tracks.items():
                    effort = key == "states" and "effort" in made.columns
                    item[key][named[part]] = {
                        "qpos": row_of(t.state if key == "states" else t.action, i),
                        "qvel": [],
                        "torque": row_of(t.effort, i) if effort else [],
                    }
                item[key]["body"] = None if old else {"qpos": []}
            item |= {"tactiles": None, "audios": None}
            if not old:
                item["sim_state"] = None
            items.append(item)
        lists = {p: [] if newest else [f"k{p.split('_')[0].capitalize()}{j}" for j in ARM]
                 for p in made.parts if "arm" in p}  # fmt: skip
        info = {
            "version": "1.0.0", "date": "2026-10-08", "author": "unitree",
            "image": {"width": SIZE[0], "height": SIZE[1], "fps": made.fps},
            "depth": {"width": SIZE[0], "height": SIZE[1], "fps": made.fps},
            "audio": {"sample_rate": 16000, "channels": 1, "format": "PCM", "bits": 16},
            "joint_names": {name: lists.get(name, []) for name in (*named.values(), "body")},
            "tactile_names": {"left_ee": [], "right_ee": []},
        }  # fmt: skip
        text = {"goal": take.task, "desc": "", "steps": ""}
        if newest:
            head = [json.dumps(x, indent=4) for x in (info, text)]
            lines = ",\n".join(json.dumps(item) for item in items)
            written = f'{{\n"info": {head[0]},\n"text": {head[1]},\n"data": [\n{lines}\n]\n}}'
        else:
            whole = {"info": info, "text": text, "data": items}
            written = json.dumps(whole, indent=4, ensure_ascii=False)
        data_bytes = written.encode()
        if "latin" in take.done:  # as an editor with another encoding saved it
            data_bytes = data_bytes.replace(take.task.encode(), b"D\xe9poser la pi\xe8ce")
        if "cut" in take.done:
            data_bytes = data_bytes[: round(len(data_bytes) * take.done["cut"])]
        (folder / "data.json").write_bytes(data_bytes)
