"""Author g: sets of good but unusual and of spoiled episodes, for who judges datasets.

    python -m tools.spoiled_sets.author_g OUT

Hands move along strokes that are cut from the shipped samples, mirrored, warped and recombined, or
as the samples themselves; arms reach and hold as a person's do. States come from a model of arm
and hand: delay, overshoot, sag, objects, noise and steps of the encoders. Everything is the same
in every run.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.spoiled_sets.g_files import (
    Rng,
    Set,
    Take,
    Track,
    make,
    piece,
    strokes,
    write_lerobot,
    write_xr,
)
from tools.spoiled_sets.lerobot_files import SIDES

# -- faults -----------------------------------------------------------------------------------


@dataclass
class Found:
    """Where the fault is."""

    part: str = ""
    joints: tuple[int, ...] = ()
    begin: float | None = None
    end: float | None = None


def busiest(take: Take, parts: list[str], frames: int) -> int:
    """The first frame of the window in which the actions of these parts move most."""
    way = sum(
        (
            np.abs(np.diff(take.tracks[p].action, axis=0)).sum(axis=1)
            / (np.ptp(take.tracks[p].action, axis=0).sum() + 1e-9)
            for p in parts
        ),
        np.zeros(len(take) - 1),
    )
    total = np.concatenate([[0], np.cumsum(way)])
    edge = min(10, (len(take) - frames) // 2)
    sums = total[frames:] - total[:-frames]
    return edge + int(np.argmax(sums[edge : len(sums) - edge])) if len(sums) > 2 * edge else 0


def window(made: Set, take: Take, parts: list[str], kw: dict[str, Any]) -> slice:
    """The frames of a fault: all, from a share on, or some seconds at the busiest place."""
    if "seconds" in kw:
        frames = round(kw["seconds"] * made.fps)
        begin = busiest(take, parts, frames)
        return slice(begin, begin + frames)
    return slice(round(kw.get("since", 0.0) * len(take)), len(take))


def trim(take: Take, keep: NDArray[np.int64]) -> None:
    """Leave only these frames; they are numbered anew."""
    for t in take.tracks.values():
        for name in ("action", "state", "velocity", "effort"):
            setattr(t, name, getattr(t, name)[keep])
    take.touch = {s: v[keep] for s, v in take.touch.items()}
    take.seen = take.seen[keep]
    take.shown = {c: np.arange(len(keep)) for c in take.shown}
    take.number = np.arange(len(keep))


def busiest_joints(track: Track, count: int = 1, over: slice | None = None) -> list[int]:
    """The joints whose action moves most."""
    wide = np.ptp(track.action[over or slice(None)], axis=0)
    return sorted(np.argsort(wide)[::-1][:count].tolist())


def spoil(made: Set, take: Take, rng: Rng, fault: str, kw: dict[str, Any]) -> Found:
    """Put a fault into an episode."""
    part = kw.get("part", "")
    chosen = [part] if part else list(take.tracks)
    if part in SIDES:
        chosen = [p for p in take.tracks if p.startswith(part)]
    if part == "hands":
        chosen = [p for p in take.tracks if p.endswith("hand")]
    at = window(made, take, chosen, kw)
    found = Found(part if part in take.tracks else "", (), at.start / made.fps, at.stop / made.fps)
    n = len(take)
    tracks = [take.tracks[p] for p in chosen]

    if fault in ("frozen_joint", "frozen_side", "frozen_all"):
        joints = kw.get("joints")
        if fault == "frozen_joint" and joints is None:
            joints = busiest_joints(tracks[0], 1, at)
        for t in tracks:
            for j in joints if joints is not None else range(t.state.shape[1]):
                t.state[at, j] = t.state[at.start, j]
                t.velocity[at, j] = 0 if not kw.get("reader") else t.velocity[at.start, j]
                t.effort[at, j] = t.effort[at.start, j]
        found.joints = tuple(joints or ())
        if fault == "frozen_all":
            for v in take.touch.values():
                v[at] = v[at.start]
    elif fault == "repeated_frames":
        held: NDArray[np.int64] = np.arange(n, dtype=np.int64)
        rows = np.arange(at.start, at.stop)
        held[rows] = at.start + (rows - at.start) // kw["times"] * kw["times"]
        for t in tracks:
            names = ("state", "velocity", "effort") + (("action",) if kw.get("all") else ())
            for name in names:
                setattr(t, name, getattr(t, name)[held])
        take.touch = {s: v[held] for s, v in take.touch.items()}
        if kw.get("all"):
            take.shown = {c: v[held] for c, v in take.shown.items()}
    elif fault in ("action_shift", "lag_drift"):
        frames = kw["by"] * made.fps
        lag = np.full(n, frames) if fault == "action_shift" else np.linspace(0, frames, n)
        keep = np.arange(max(0, -round(float(lag.min()))), n - max(0, round(float(lag.max()))))
        source = np.round(keep + lag[: len(keep)] if fault == "lag_drift" else keep + frames)
        actions = {p: t.action[source.astype(int)] for p, t in take.tracks.items()}
        trim(take, keep)
        for p in chosen:
            take.tracks[p].action = actions[p]
        found.begin, found.end = 0.0, len(keep) / made.fps
    elif fault == "clipped_action":
        t = tracks[0]
        joints = kw.get("joints") or busiest_joints(t)
        for j in joints:
            rest = np.median(t.action[:5, j])
            away = t.action[:, j] - rest
            sign = 1 if abs(away.max()) > abs(away.min()) else -1
            bound = rest + sign * np.abs(away).max() * kw["at"]
            over = sign * (t.action[:, j] - bound)
            t.action[:, j] = np.where(over > 0, bound, t.action[:, j])
        found.joints = tuple(joints)
    elif fault == "not_followed":
        for t in tracks:
            rows = np.arange(at.start, at.stop)
            begin = t.state[at.start].copy()
            sink = 1 - np.exp(-(rows - at.start) / (kw.get("sink", 0.6) * made.fps))
            down = kw.get("to")
            goal = begin if down is None else begin + (np.asarray(down) - begin) * 1.0
            still = begin + sink[:, None] * (goal - begin)
            noise = rng.normal(0, 0.0007, still.shape)
            t.state[at] = np.round((still + noise) * 1000) / 1000
            t.velocity[at] = np.gradient(still, 1 / made.fps, axis=0)
            t.velocity[at] += rng.normal(0, 0.01, still.shape)
            t.effort[at] = rng.normal(0, 0.008, still.shape)
        for side, v in take.touch.items():
            if f"{side}_hand" in chosen:
                v[at] = np.round(np.abs(rng.normal(0, 3, v[at].shape)))
    elif fault == "jump":
        t = tracks[0]
        joints = kw.get("joints") or busiest_joints(t)
        begin = int(n * kw.get("when", 0.5))
        stop = begin + kw["frames"] if "frames" in kw else n
        for j in joints:
            t.state[begin:stop, j] += kw["by"]
            if kw.get("action"):
                t.action[begin:stop, j] += kw["by"]
        found.joints, found.begin = tuple(joints), begin / made.fps
        found.end = stop / made.fps
    elif fault == "wrong_unit":
        for p, t in zip(chosen, tracks, strict=True):
            for name in kw.get("of", ("state",)):
                x = getattr(t, name)
                unit = kw["unit"]
                if unit == "deg":
                    x = np.degrees(x)
                elif unit == "percent":
                    x = x * 100
                elif unit == "1..0":
                    x = 1 - x
                elif unit == "int":
                    x = np.round(x * 1000)
                elif unit == "0..1":
                    side = p.split("_")[0]
                    top = np.abs(np.stack([s[-1] for s in strokes(made.model, side)])).max(axis=0)
                    x = x / (5.4 if made.model == "dex1-1" else np.maximum(top, 0.3) * 1.25)
                setattr(t, name, x)
    elif fault == "wrong_side":
        kind = kw.get("kind", "hand")
        a, b = take.tracks[f"left_{kind}"], take.tracks[f"right_{kind}"]
        for name in ("state", "velocity", "effort") if not kw.get("action") else ("action",):
            x, y = getattr(a, name), getattr(b, name)
            setattr(a, name, y)
            setattr(b, name, x)
        found.part = ""
    elif fault == "wrong_joint_order":
        t = tracks[0]
        order = np.array(kw["order"])
        for name in ("state", "velocity", "effort") if not kw.get("action") else ("action",):
            setattr(t, name, getattr(t, name)[:, order])
        found.joints = tuple(np.flatnonzero(order != np.arange(len(order))).tolist())
    elif fault == "inverted_sign":
        t = tracks[0]
        joints = kw.get("joints") or busiest_joints(t)
        for j in joints:
            name = "action" if kw.get("action") else "state"
            getattr(t, name)[:, j] *= -1
            if name == "state":
                t.velocity[:, j] *= -1
                t.effort[:, j] *= -1
        found.joints = tuple(joints)
    elif fault == "missing_stretch":
        keep = np.delete(np.arange(n), at)
        trim(take, keep)
        if kw.get("numbered"):
            take.number = keep
        else:
            found.end = found.begin
    elif fault == "idle_start":
        found.begin, found.end = 0.0, kw["of_plan"]
    elif fault == "idle_end":
        found.begin, found.end = take.done["until"], n / made.fps
    elif fault in ("grasp_on_nothing", "drop_in_grasp"):
        found.part = f"{kw['side']}_hand"
        spans = take.done["spans"][kw["side"]]
        if fault == "drop_in_grasp":
            found.begin, found.end = float(spans[0][1]), float(spans[-1][1]) + 1
        else:
            found.begin, found.end = 0.0, n / made.fps
    elif fault.startswith("camera"):
        _camera(made, take, fault, kw, found)
    elif fault == "no_task":
        take.task = kw.get("text", "")
    elif fault == "wrong_stats":
        take.done["stats"] = kw["by"]
    elif fault == "not_finite":
        t = tracks[0]
        begin = int(n * kw.get("when", 0.45))
        joints = kw.get("joints") or list(range(t.state.shape[1]))
        for j in joints:
            name = "action" if kw.get("action") else "state"
            getattr(t, name)[begin : begin + kw["frames"], j] = kw.get("value", np.nan)
        found.joints = tuple(kw.get("joints", ()))
        found.begin, found.end = begin / made.fps, (begin + kw["frames"]) / made.fps
    elif fault == "broken_file":
        take.done |= {k: kw[k] for k in ("half", "rows", "cut", "latin") if k in kw}
        found.begin = found.end = None
    elif fault not in ("wrong_fps", "duplicate"):
        raise ValueError(fault)
    if fault in ("no_task", "wrong_stats", "duplicate"):
        found.begin = found.end = None
    return found


def _camera(made: Set, take: Take, fault: str, kw: dict[str, Any], found: Found) -> None:
    n = len(take)
    name = kw["camera"]
    found.part = f"camera {name}"
    shown: NDArray[np.int64] = np.arange(n)
    if fault == "camera_frozen":
        at = window(made, take, [p for p in take.tracks if "arm" in p], kw)
        shown[at] = at.start
        found.begin, found.end = at.start / made.fps, at.stop / made.fps
    elif fault == "camera_late":
        late = kw["by"] * made.fps * (np.linspace(0, 1, n) if kw.get("drifts") else np.ones(n))
        shown = np.maximum(0, np.round(np.arange(n) - late)).astype(int)
    elif fault == "camera_early_end":
        shown = shown[: round(n * kw["at"])]
        found.begin, found.end = len(shown) / made.fps, n / made.fps
    elif fault == "camera_missing":
        take.done["no camera"] = name
    take.shown[name] = shown


# -- the sets ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Entry:
    """One episode: good, or with one fault.

    :param style: of its motion.
    :param do: what the fault is like.
    """

    fault: str
    say: str
    style: dict[str, Any]
    do: dict[str, Any]
    strength: str = "plain"


def good(say: str, **style: Any) -> Entry:
    """A good episode that is unusual as ``say`` tells."""
    return Entry("good", say, style, {})


def bad(fault: str, say: str, style: dict[str, Any] | None = None, **do: Any) -> Entry:
    """A spoiled episode; ``mild`` for a fault that is not plain."""
    strength = "moderate" if do.pop("mild", False) else "plain"
    style = dict(style or {})
    if fault in ("idle_start", "idle_end"):
        style.setdefault("seconds", do["of_plan"] + do.pop("busy"))
        if fault == "idle_end":
            style["end"] = do["of_plan"]
        else:
            style["pauses"] = ((0.2, do["of_plan"]),)
    if fault == "grasp_on_nothing":
        style["nothing"] = do["side"]
    if fault == "drop_in_grasp":
        style["drop"] = do["side"]
    return Entry(fault, say, style, do, strength)


def build(out: Path, made: Set, entries: list[Entry], seed: int) -> list[dict[str, Any]]:
    """Write a set and tell its labels."""
    takes: list[Take] = []
    labels = []
    for e, entry in enumerate(entries):
        rng = np.random.default_rng(seed * 7919 + e)
        maker: Callable[..., Take] = piece if made.name.startswith("g_export") else make
        like = entry.style.get("like")
        own = seed * 1000 + (e if like is None else like)
        if "copy" in entry.do:
            first = takes[entry.do["copy"]]
            tracks = {p: replace(t) for p, t in first.tracks.items()}
            noise = entry.do.get("noise", 0.0)
            for t in tracks.values():
                for name in ("action", "state", "velocity", "effort"):
                    x = getattr(t, name)
                    setattr(t, name, x + noise * rng.normal(0, 1, x.shape))
            take = replace(first, tracks=tracks, done={}, task=entry.do.get("task", first.task))
        elif like is not None:
            take = make(made, {**entries[like].style, **entry.style}, own, alike=e)
        else:
            take = maker(made, entry.style, own)
        found = Found()
        if entry.fault != "good":
            found = spoil(made, take, rng, entry.fault, entry.do)
        take.done.pop("spans", None)
        take.done.pop("until", None)
        takes.append(take)
        xr = made.form.startswith("xr")
        labels.append(
            {
                "dataset": made.name,
                "form": f"lerobot-{made.form}" if not xr else made.form.replace(" ", "-"),
                "episode": f"episode_{e:04d}" if xr else e,
                "expect": "good" if entry.fault == "good" else "spoiled",
                "fault": "" if entry.fault == "good" else entry.fault,
                "part": found.part,
                "joints": list(found.joints),
                "begin_s": None if found.begin is None else round(found.begin, 2),
                "end_s": None if found.end is None else round(found.end, 2),
                "strength": "" if entry.fault == "good" else entry.strength,
                "say": entry.say,
            }
        )
    (write_xr if made.form.startswith("xr") else write_lerobot)(out / made.name, made, takes)
    return labels


HANDS_ONLY = ("left_hand", "right_hand")
RIGHT_ONLY = ("right_arm", "right_hand")
MORE = ("state", "velocity", "effort")
BOTH = ("state", "action")
LIMP = [0.3, -0.1, 0.0, 0.15, 0.0, 0.0, 0.0]

Plan = tuple[Set, list[Entry]]


def cups() -> Plan:
    """Dex3-1, LeRobot v3.0 with two cameras."""
    made = Set("g_dex3_cups", "v3.0", "dex3-1", 30, cameras=("cam_left_high", "cam_right_high"),
               task="Stack the paper cups.")  # fmt: skip
    tall = {"seconds": 14.0}
    return made, [
        good("The left hand is never closed.", hands="right"),
        good("A slow operator.", pace=0.45, seconds=24.0),
        good("A very quick operator.", pace=2.2, seconds=7.0),
        good("A cup is held for 20 s while the command keeps closing.", hold=20.0, seconds=30.0),
        good("Left arm and hand rest, with commands that stay the same to the last digit.",
             arms="right", hands="right", dead_still=True),
        good("A pause of 2.2 s in the middle.", pauses=((5.0, 2.2),), seconds=13.0),
        good("A soft object that gives way.", soft=0.35),
        good("Episode 5 once more by the same person: alike, not a copy.", like=5),
        good("A shaky operator.", tremor=2.4),
        good("A short episode of 4.2 s.", pace=2.0, seconds=4.2, start=0.2),
        good("Three places are visited with a cup in the hand.", carries=3, seconds=13.0),
        bad("frozen_joint", "One joint of the right hand reads the same all the time.",
            part="right_hand"),
        bad("camera_frozen", "The head camera shows one picture from the middle on.", tall,
            camera="cam_left_high", since=0.5),
        bad("camera_late", "The right camera falls behind, by 1.5 s at the end.", tall,
            camera="cam_right_high", by=1.5, drifts=True),
        bad("camera_early_end", "The video of the head camera ends at 70 % of the episode.", tall,
            camera="cam_left_high", at=0.7, mild=True),
        bad("action_shift", "Actions are 0.7 s earlier than they were against the observations.",
            tall, by=0.7),
        bad("not_followed", "The right hand trips and stays as it is.", tall, part="right_hand",
            since=0.4, mild=True),
        bad("missing_stretch", "1.2 s of motion are missing, and the frames are numbered on.", tall,
            seconds=1.2, mild=True),
        bad("wrong_joint_order", "Index and middle of the right hand's state are exchanged.",
            {"stroke": 0, "object": False}, part="right_hand", order=[0, 1, 2, 5, 6, 3, 4],
            mild=True),
        bad("wrong_stats", "The statistics of the episode are those of degrees.",
            by=(57.29578, 0.0)),
        bad("duplicate", "Episode 2 once more, with another task.", copy=2,
            task="Put the cups into the bin."),
        bad("lag_drift", "Observations fall behind the actions, by 1.3 s at the end.",
            {"seconds": 16.0}, by=1.3),
    ]  # fmt: skip


def sort() -> Plan:
    """Dex1-1, LeRobot v2.1 with a camera."""
    made = Set("g_dex1_sort", "v2.1", "dex1-1", 30, cameras=("cam_left_high",),
               task="Sort the blocks by colour.")  # fmt: skip
    return made, [
        good("Grippers that begin closed and only open.", closed_first=1.0, only_opens=True,
             object=False),
        good("Coarse encoders: 0.05 rad of the gripper, 0.01 rad of the arm.",
             step={"hand": 0.05, "arm": 0.01}),
        good("Noisy encoders.", noise=8.0),
        good("States a little beyond the limits, as of a gripper whose zero is not exact.",
             offset=0.012),
        good("Arms stand; the grippers go to both ends of their stroke again and again.",
             object=False, arms="none", carries=0, hold=0.5, pace=1.2),
        good("Moved by hand: the action is the state.", mode="equal"),
        good("The action is the next frame's state.", mode="next"),
        good("A gripper that answers 0.3 s late.", lag=0.3),
        good("The grippers are not used; the arms push the blocks.", hands="none"),
        good("The grippers open half only between two grasps.", half_open=0.4),
        bad("frozen_side", "The right arm reads the same all the time.", part="right_arm"),
        bad("camera_missing", "There is no video of this episode.", camera="cam_left_high"),
        bad("broken_file", "The Parquet file ends at 60 %.", half=0.6),
        bad("broken_file", "The Parquet file has two rows less than the metadata says.", rows=2,
            mild=True),
        bad("no_task", "The task is empty."),
        bad("wrong_stats", "The statistics are those of data divided by five.", by=(0.2, 0.0)),
        bad("wrong_unit", "The left gripper's state is 0 to 1, its action rad.", part="left_hand",
            unit="0..1"),
        bad("inverted_sign", "The left elbow's state has the other sign.", part="left_arm",
            joints=[3]),
        bad("not_finite", "The left arm's state is NaN in three frames.", part="left_arm",
            frames=3, mild=True),
        bad("clipped_action", "The right gripper's action stops at half, the gripper goes on.",
            {"object": False}, part="right_hand", at=0.5, mild=True),
        bad("jump", "The left shoulder's state is 0.6 rad off in two frames.", part="left_arm",
            joints=[1], by=0.6, frames=2, mild=True),
    ]  # fmt: skip


def signs() -> Plan:
    """BrainCo, LeRobot v2.0 without cameras."""
    made = Set("g_brainco_signs", "v2.0", "brainco-revo2", 15, task="Hand over the bottle.")
    return made, [
        good("Only the left hand is used; both arms move.", hands="left"),
        good("Positions of the hand in steps of one percent.", step={"hand": 0.01, "arm": 0.0002}),
        good("The hands close to 40 % only.", amp=0.4, object=False),
        good("Fingers close one after another.", roll=0.5, fingers=0.4),
        good("38 s long and slow.", seconds=38.0, pace=0.5),
        good("Episode 3 once more: alike, not a copy.", like=3),
        good("Two pauses in which the operator looks.", pauses=((3.5, 1.8), (8.0, 2.0)),
             seconds=15.0),
        good("The right arm rests while its hand works.", arms="left"),
        good("A soft object.", soft=0.45),
        bad("wrong_unit", "The right hand's state is in percent.", part="right_hand",
            unit="percent"),
        bad("wrong_unit", "The left hand's state is 1 open, 0 closed.", part="left_hand",
            unit="1..0"),
        bad("wrong_side", "The hands' states are exchanged.", {"seconds": 12.0}),
        bad("wrong_joint_order", "The left hand's state runs from pinky to thumb.",
            {"roll": 0.6, "fingers": 0.6, "object": False}, part="left_hand",
            order=[5, 4, 3, 2, 1, 0]),
        bad("frozen_all", "From the middle on all states are the same.", since=0.5),
        bad("repeated_frames", "Observations are new in every fourth frame only.", times=4,
            mild=True),
        bad("idle_end", "The operator stands still for about 14 s at the end.", of_plan=14.0,
            busy=8.0),
        bad("duplicate", "Episode 4 once more, with a little noise.", copy=4, noise=0.0008,
            mild=True),
        bad("not_finite", "One action of the right hand is infinite.", part="right_hand",
            joints=[2], frames=1, value=np.inf, action=True, mild=True),
        bad("lag_drift", "Observations fall behind, by 0.9 s at the end.", {"seconds": 15.0},
            by=0.9, mild=True),
    ]  # fmt: skip


def touch() -> Plan:
    """Inspire FTP with touch, LeRobot v2.1, names of dexkit."""
    made = Set("g_ftp_touch", "v2.1", "inspire-ftp", 20, names="dexkit",
               columns=("state", "effort", "pressure"), task="Lift the fruit.")  # fmt: skip
    long = {"hold": 2.5, "seconds": 14.0}
    return made, [
        good("A fruit is held for 18 s.", hold=18.0, seconds=26.0),
        good("A small fruit: the hands are almost closed when they meet it.", size=0.8),
        good("A large fruit.", size=0.36),
        good("Something very soft.", soft=0.5),
        good("Arms rest on the table while the hands grasp.", arms="none", carries=0, hold=1.5),
        good("A very quick operator.", pace=1.8),
        good("Only the right hand grasps.", hands="right"),
        good("The hands close to three quarters only and press little.", strong=0.74, size=0.6),
        good("Episode 2 once more: alike, not a copy.", like=2),
        bad("grasp_on_nothing", "The right hand closes on nothing each time.", long, side="right"),
        bad("grasp_on_nothing", "The left hand closes on nothing each time.",
            {"seconds": 9.0}, side="left", mild=True),
        bad("drop_in_grasp", "The fruit falls from the closed right hand.", long, side="right"),
        bad("drop_in_grasp", "The fruit falls from the closed left hand.",
            {"hold": 2.0, "seconds": 11.0, "soft": 0.1}, side="left", mild=True),
        bad("frozen_side", "The right hand reads the same all the time.", part="right_hand"),
        bad("not_followed", "The left hand is off.", part="left_hand", since=0.0),
        bad("action_shift", "Actions come 0.45 s after the motion that they command.",
            {"seconds": 12.0}, by=-0.45, mild=True),
        bad("missing_stretch", "1.5 s are missing; the numbering tells.", seconds=1.5,
            numbered=True),
        bad("wrong_unit", "The right hand is in whole numbers up to 1000.", part="right_hand",
            unit="int", of=BOTH),
        bad("wrong_stats", "The statistics are those of other data.", by=(1.0, 1.5), mild=True),
    ]  # fmt: skip


def fingers() -> Plan:
    """Dex5-1 without arms, LeRobot v3.0 at 50 fps."""
    made = Set("g_dex5_fingers", "v3.0", "dex5-1", 50, names="dexkit", columns=MORE,
               parts=HANDS_ONLY, task="Turn the knob.")  # fmt: skip
    short = {"seconds": 9.0}
    return made, [
        good("Only the left hand is used.", hands="left", seconds=8.0),
        good("Very quick.", pace=2.0, seconds=6.0),
        good("Slow.", pace=0.5, seconds=18.0),
        good("Noisy encoders.", noise=5.0, seconds=7.0),
        good("The fingers close to a third.", amp=0.35, object=False, seconds=8.0),
        good("Fingers close one after another, with different strength.", roll=0.6, fingers=0.5,
             seconds=9.0),
        good("A knob is held for 15 s.", hold=15.0, seconds=21.0),
        good("A soft knob.", soft=0.4, seconds=8.0),
        good("Hands that begin closed and only open.", closed_first=1.0, only_opens=True,
             object=False, seconds=4.5, carries=0, hold=0.1, pace=1.4),
        bad("wrong_fps", "The loop ran at 25 Hz, the dataset says 50; velocities tell.",
            {"seconds": 9.0, "hz": 25}),
        bad("wrong_fps", "The loop ran at 30 Hz, the dataset says 50; velocities tell.",
            {"seconds": 9.0, "hz": 30}, mild=True),
        bad("frozen_joint", "One joint of the left hand reads the same for 4 s.", short,
            part="left_hand", seconds=4.0, mild=True),
        bad("jump", "A finger's state steps by 0.5 rad and stays so.", short, part="right_hand",
            by=0.5, mild=True),
        bad("wrong_unit", "The left hand's state is in degrees.", short, part="left_hand",
            unit="deg"),
        bad("grasp_on_nothing", "The right hand closes on nothing.", short, side="right"),
        bad("repeated_frames", "All that was recorded stalls again and again for 4 s, for seven "
            "frames each.", short, seconds=4.0, times=7, all=True, mild=True),
        bad("wrong_side", "The hands' states are exchanged.", short),
        bad("inverted_sign", "Two joints' states of the right hand have the other sign.", short,
            part="right_hand", joints=[1, 2]),
    ]  # fmt: skip


def grippers() -> Plan:
    """Two grippers with other people's names, LeRobot v3.0 at 60 fps."""
    made = Set("g_two_grippers", "v3.0", "dex1-1", 60, names="other", cameras=("front",),
               task="Fold the towel.")  # fmt: skip
    short = {"seconds": 10.0}
    return made, [
        good("Grippers that answer 0.3 s late.", lag=0.3, seconds=9.0),
        good("4.5 s only.", seconds=4.5, pace=1.8, start=0.2),
        good("The action is the next frame's state.", mode="next", seconds=7.0),
        good("Moved by hand: the action is the state.", mode="equal", seconds=7.0),
        good("The towel is held for 12 s.", hold=12.0, seconds=17.0),
        good("Episode 4 once more: alike, not a copy.", like=4, seconds=17.0),
        good("The right arm rests.", arms="left", hands="left", dead_still=True, seconds=8.0),
        good("Arms that sag by 4 degrees.", sag=3.0, seconds=8.0),
        good("Grippers open half.", half_open=0.5, seconds=8.0),
        bad("camera_late", "The camera is 0.8 s late throughout.", short, camera="front", by=0.8,
            mild=True),
        bad("camera_frozen", "The camera stands still for 3 s.", short, camera="front",
            seconds=3.0, mild=True),
        bad("frozen_joint", "The left elbow reads the same all the time.", short, part="left_arm",
            joints=[3]),
        bad("action_shift", "Actions are 0.9 s early.", short, by=0.9),
        bad("clipped_action", "The left arm's widest joint is clipped in half of its way.", short,
            part="left_arm", at=0.45, mild=True),
        bad("no_task", "The task is empty.", short),
        bad("idle_start", "Nothing happens for the first 15 s.", of_plan=15.0, busy=7.0),
        bad("camera_early_end", "The camera's video ends in the middle.", short, camera="front",
            at=0.5),
    ]  # fmt: skip


def degrees() -> Plan:
    """A whole set in degrees."""
    made = Set("g_all_degrees", "v2.1", "dex3-1", 30, task="Open the drawer.")
    return made, [
        bad("wrong_unit", "All of the set is in degrees, which the names do not say.",
            {"seconds": 6.0 + i, "pace": 0.8 + 0.1 * i}, unit="deg", of=BOTH)
        for i in range(6)
    ]  # fmt: skip


def old_folder() -> Plan:
    """Dex3-1, a task folder of xr_teleoperate v0.5 with pictures."""
    made = Set("g_xr_dex3_old", "xr v0.5", "dex3-1", 30, cameras=("color_0",),
               task="Put the piece away.")  # fmt: skip
    short = {"seconds": 9.0}
    return made, [
        good("Only the right side works.", arms="right", hands="right", seconds=7.0),
        good("A pause of 3 s.", pauses=((4.0, 3.0),), seconds=11.0),
        good("Quick.", pace=2.0, seconds=5.0),
        good("Coarse encoders.", step={"hand": 0.02, "arm": 0.008}, seconds=8.0),
        good("A slow arm with 150 ms.", wn=11.0, delay=0.05, seconds=9.0),
        good("The hands hold nothing; they point.", object=False, seconds=8.0),
        good("The hands stay half closed.", half_open=0.4, closed_first=0.4, size=0.85,
             seconds=8.0),
        good("Long rest of one hand, then both.", start=1.8, seconds=9.0),
        bad("camera_missing", "None of the pictures is there.", short, camera="color_0"),
        bad("broken_file", "The JSON file ends in the middle of an item.", short, cut=0.35),
        bad("broken_file", "The text of the task is no UTF-8.", short, latin=True),
        bad("wrong_side", "The hands' states are exchanged.", short),
        bad("missing_stretch", "1 s of frames is missing; their numbers tell.", short, seconds=1.0,
            numbered=True, mild=True),
        bad("frozen_joint", "The right shoulder roll reads the same from a third on.",
            {"seconds": 11.0}, part="right_arm", joints=[1], since=0.33),
        bad("wrong_joint_order", "Shoulder pitch and yaw of the left arm's state are exchanged.",
            short, part="left_arm", order=[2, 1, 0, 3, 4, 5, 6]),
        bad("not_followed", "The right arm goes limp and sinks.", {"seconds": 11.0},
            part="right_arm", since=0.4, to=LIMP),
        bad("camera_frozen", "The camera shows the same picture all the time.", short,
            camera="color_0", since=0.0),
        bad("wrong_unit", "The right hand's state is in degrees.", short, part="right_hand",
            unit="deg"),
    ]  # fmt: skip


def new_folder() -> Plan:
    """Inspire FTP, a task folder of v1.4 with times and torque."""
    made = Set("g_xr_ftp_new", "xr v1.4", "inspire-ftp", 30, columns=("state", "effort"),
               timed=True, task="Water the plant.")  # fmt: skip
    long = {"hold": 2.5, "seconds": 13.0}
    return made, [
        good("The left hand is never used.", hands="right"),
        good("The can is held for 16 s.", hold=16.0, seconds=22.0),
        good("A soft sponge.", soft=0.5),
        good("Coarse: steps of a hundredth.", step={"hand": 0.01, "arm": 0.002}),
        good("The loop ran at 29.2 Hz instead of 30.", hz=29.2),
        good("A shaky operator.", tremor=2.2),
        good("Slow.", pace=0.5, seconds=20.0),
        good("The arms rest.", arms="none", carries=0, hold=1.0),
        good("A large can.", size=0.35),
        bad("wrong_fps", "The loop ran at 15 Hz, the file says 30; the stamps tell.",
            {"hz": 15}),
        bad("wrong_fps", "The loop ran at 22 Hz, the file says 30; the stamps tell.",
            {"hz": 22}, mild=True),
        bad("drop_in_grasp", "The can falls from the closed right hand.", long, side="right"),
        bad("grasp_on_nothing", "The left hand closes on nothing.", long, side="left"),
        bad("broken_file", "The file was cut at 80 %.", cut=0.8, mild=True),
        bad("no_task", "There is no goal."),
        bad("inverted_sign", "The right shoulder pitch's state has the other sign.",
            {"seconds": 11.0}, part="right_arm", joints=[0]),
        bad("wrong_joint_order", "The right hand's state runs from thumb to pinky.",
            {"roll": 0.6, "fingers": 0.6, "object": False}, part="right_hand",
            order=[5, 4, 3, 2, 1, 0]),
        bad("not_followed", "Both hands stop following at 30 %.", {"seconds": 12.0}, part="hands",
            since=0.3),
    ]  # fmt: skip


def quick_folder() -> Plan:
    """Dex1-1, a task folder of v1.1 at 60 fps."""
    made = Set("g_xr_dex1_quick", "xr v1.1", "dex1-1", 60, task="Pick the screws.")
    short = {"seconds": 9.0}
    return made, [
        good("Quick.", pace=2.2, seconds=5.0),
        good("Grippers open and shut often, the arms stand.", arms="none", object=False, carries=0,
             hold=0.5, pace=1.1, seconds=9.0),
        good("The left gripper is not used.", hands="right", seconds=8.0),
        good("A screw is held for 10 s.", hold=10.0, seconds=15.0),
        good("Noisy encoders.", noise=7.0, seconds=7.0),
        good("Grippers open half.", half_open=0.45, seconds=8.0),
        good("The right arm rests on the table.", arms="left", hands="left", seconds=8.0),
        good("A gripper at half speed.", speed=0.45, pace=0.7, seconds=11.0),
        good("The action is the next frame's state.", mode="next", seconds=7.0),
        bad("repeated_frames", "States are new in every twelfth frame only.", short, times=12),
        bad("jump", "The right elbow's state and action step by 0.8 rad.", short,
            part="right_arm", joints=[3], by=0.8, action=True),
        bad("lag_drift", "Observations fall behind, by 1.2 s at the end.", {"seconds": 13.0},
            by=1.2),
        bad("duplicate", "Episode 3 once more.", copy=3),
        bad("idle_start", "Nothing happens for 9 s of 15.", of_plan=9.0, busy=6.0, mild=True),
        bad("idle_end", "Nothing happens in the last 10 s or so.", of_plan=10.0, busy=7.0,
            mild=True),
        bad("not_finite", "The right gripper's state is NaN for ten frames.", short,
            part="right_hand", joints=[0], frames=10),
        bad("frozen_all", "All states stand still for 3 s and go on.", short, seconds=3.0,
            mild=True),
    ]  # fmt: skip


def ten() -> Plan:
    """A right arm with Inspire DFX at 10 fps, LeRobot v3.0."""
    made = Set("g_dfx_right_ten", "v3.0", "inspire-dfx", 10, names="dexkit", parts=RIGHT_ONLY,
               task="Wipe the table.")  # fmt: skip
    long = {"seconds": 18.0}
    return made, [
        good("A right arm only, at 10 fps.", seconds=15.0),
        good("Slow.", pace=0.5, seconds=30.0),
        good("Fingers close one after another.", roll=0.5, fingers=0.4),
        good("The hand is not used.", hands="none"),
        good("The arm rests, the hand works.", arms="none", carries=0, hold=0.8, seconds=12.0),
        good("A pause of 2 s.", pauses=((6.0, 2.0),), seconds=16.0),
        good("A hand that answers 0.3 s late.", lag=0.3, seconds=16.0),
        good("The action is the next frame's state.", mode="next", seconds=14.0),
        good("Noisy encoders.", noise=6.0, seconds=14.0),
        bad("frozen_side", "The hand reads the same all the time.", long, part="right_hand"),
        bad("not_followed", "The hand is off for the second half.", long, part="right_hand",
            since=0.5),
        bad("wrong_unit", "The state of the hand is 0 open, 1 closed.", long, part="right_hand",
            unit="1..0"),
        bad("action_shift", "Actions come 0.6 s after the motion that they command.", long,
            by=-0.6),
        bad("wrong_stats", "The statistics are those of degrees.", long, by=(57.29578, 0.0)),
        bad("idle_end", "Nothing happens in the last 20 s or so.", of_plan=20.0, busy=8.0),
        bad("missing_stretch", "2 s of motion are missing, and the frames are numbered on.", long,
            seconds=2.0),
        bad("clipped_action", "The hand's actions stop at 0.6, it closes further.",
            {"seconds": 16.0, "object": False}, part="right_hand", joints=[0, 1, 2, 3], at=0.4),
        bad("frozen_joint", "The index reads the same for 8 s.", long, part="right_hand",
            joints=[3], seconds=8.0, mild=True),
    ]  # fmt: skip


def exported() -> Plan:
    """Pieces of dexkit's samples of the gripper as they were, with velocity and torque."""
    made = Set("g_export_grippers", "v3.0", "dex1-1", 30, names="dexkit", columns=MORE,
               parts=HANDS_ONLY, task="Try the grippers.")  # fmt: skip
    short = {"seconds": 9.0}
    return made, [
        good("Both grippers of one session, with an object twice.", begin=4.0,
             **{"from": "dex1_pick_place"}, seconds=15.0, warp=1.0),
        good("Quick full strokes and short pinches.", **{"from": "dex1_idle_then_startle"},
             begin=9.0, seconds=9.0, warp=1.0),
        good("A session of the older controller.",
             **{"from": "dex1_legacy_v1_1"}, begin=2.0, seconds=11.0, warp=1.1),
        good("Slow strokes.", warp=1.9, seconds=14.0),
        good("Short.", warp=0.9, seconds=4.5),
        good("The grippers work on their own, one quicker than the other.", seconds=10.0),
        good("Long, at the operator's own pace.", warp=1.5, seconds=16.0),
        good("Quick.", warp=0.8, seconds=6.0),
        good("The grippers rest on objects for some of the time.", seconds=12.0),
        bad("wrong_fps", "The loop ran at 15 Hz, the dataset says 30; velocities tell.",
            {"seconds": 9.0, "hz": 15}),
        bad("frozen_side", "The right gripper reads the same for 5 s.", short, part="right_hand",
            seconds=5.0, mild=True),
        bad("wrong_unit", "The grippers' states are in degrees.", short, unit="deg"),
        bad("jump", "The left gripper's state steps by 1.2 rad.", short, part="left_hand", by=1.2),
        bad("wrong_side", "The grippers' states are exchanged.",
            {"seconds": 13.0}),
        bad("duplicate", "Episode 1 once more.", copy=1),
        bad("repeated_frames", "States are new in every sixth frame only.", short, times=6),
    ]  # fmt: skip


def lone(name: str, form: str, gone: str, say: str) -> Plan:
    """A dataset of one episode of which a file is broken."""
    made = Set(name, form, "dex3-1", 30, gone=gone)
    return made, [bad("broken_file", say, {"seconds": 6.0})]


def write(out: Path) -> None:
    """Write all sets and their labels.

    :raises FileExistsError: there is something at ``out``.
    """
    out.mkdir(parents=True)
    plans = [
        cups(), sort(), signs(), touch(), fingers(), grippers(), degrees(), old_folder(),
        new_folder(), quick_folder(), ten(), exported(),
        lone("g_no_info", "v2.1", "info", "meta/info.json is gone."),
        lone("g_half_data", "v3.0", "half", "The only data file ends in the middle."),
    ]  # fmt: skip
    labels = []
    for i, (made, entries) in enumerate(plans):
        labels += build(out, made, entries, 40 + i)
    (out / "labels.json").write_text(json.dumps(labels, indent=1, ensure_ascii=False) + "\n")


def main() -> None:
    """Write the sets into the folder that is named, in place of what is there."""
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tools.spoiled_sets.author_g OUT")
    out = Path(sys.argv[1])
    if out.exists():
        if not (out / "labels.json").is_file():
            sys.exit(f"{out}: holds something else")
        shutil.rmtree(out)
    write(out)


if __name__ == "__main__":
    main()
