"""Recordings of the wire, cut from the samples: as they are, or with messages held, lost, moved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dexkit.traces.reader import Trace
from dexkit.traces.sessions.episodes_out import export_episodes
from dexkit.traces.sessions.rosbag import export_bag
from dexkit.traces.writer import RecordingWriter
from tools.spoiled_sets.author_f.motion import SAMPLES

__all__ = ["write_wire"]

START_NS = 1_780_000_000_000_000_000


@dataclass(frozen=True)
class Cut:
    """A side of a sample, from and to in s since its first message, and the side it becomes."""

    sample: str
    side: str
    begin: float
    end: float
    to: str


@dataclass(frozen=True)
class Wire:
    """A recording: its file (a name without suffix is of the form), its cuts, its fault."""

    name: str
    form: str
    cuts: tuple[Cut, ...]
    fault: str = ""
    part: str = ""
    strength: str = "plain"
    at: float = 0.0
    until: float = 0.0
    say: str = ""


def _both(sample: str, begin: float, end: float) -> tuple[Cut, ...]:
    return tuple(Cut(sample, s, begin, end, s) for s in ("left", "right"))


WIRES = (
    Wire("dex1_1", "mcap", _both("dex1_pick_place", 2.5, 11.8), say="Two grippers, an object."),
    Wire(
        "dex1_2",
        "mcap",
        (
            Cut("dex1_hand_dropout", "right", 1.8, 9.3, "left"),
            Cut("dex1_idle_then_startle", "right", 8.0, 15.5, "right"),
        ),
        "frozen_side",
        "right_hand",
        at=2.5,
        until=7.4,
        say="The right gripper's states repeat the last message.",
    ),
    Wire(
        "dex1_3",
        "mcap",
        (
            Cut("dex1_idle_then_startle", "left", 8.0, 17.5, "left"),
            Cut("dex1_pick_place", "right", 11.8, 21.3, "right"),
        ),
        say="A quick left gripper, the right one holds an object.",
    ),
    Wire(
        "dex1_4",
        "mcap",
        (
            Cut("dex1_pick_place", "left", 11.8, 20.0, "left"),
            Cut("dex1_hand_dropout", "right", 11.2, 19.4, "right"),
        ),
        "action_shift",
        at=0.8,
        say="Commands are stamped 0.8 s too early.",
    ),
    Wire(
        "dex1_5",
        "mcap",
        _both("dex1_hand_dropout", 6.0, 17.0),
        "missing_stretch",
        "left_hand",
        "moderate",
        at=3.5,
        until=5.0,
        say="No states of the left gripper for 1.5 s, and no commands.",
    ),
    Wire("dex3_1", "mcap", _both("dex3_pinch", 3.0, 9.5), say="A short episode with pinches."),
    Wire(
        "dex3_2",
        "mcap",
        _both("dex3_pinch", 9.6, 19.4),
        "missing_stretch",
        "",
        at=4.2,
        until=6.4,
        say="All messages of 2.2 s are lost.",
    ),
    Wire("ftp_1", "mcap", _both("inspire_ftp_grip", 0.2, 7.0), say="Hands with touch, no arms."),
    Wire(
        "ftp_2",
        "mcap",
        _both("inspire_ftp_grip", 7.2, 13.9),
        "wrong_side",
        "left_hand",
        say="The states of the hands are exchanged, the commands are not.",
    ),
    Wire("brainco_1", "mcap", _both("brainco_grip", 3.4, 8.8), say="A short episode of 5 s."),
    Wire(
        "brainco_2",
        "mcap",
        _both("brainco_grip", 6.0, 11.9),
        "broken_file",
        "",
        "plain",
        say="The second half of the recording is missing.",
    ),
    Wire("dex5_1", "mcap", _both("dex5_synthetic", 1.3, 5.9), say="A short episode of 20 joints."),
    Wire(
        "dex1_6",
        "mcap",
        (
            Cut("dex1_pick_place", "left", 2.5, 11.8, "left"),
            Cut("dex1_pick_place", "right", 2.5, 11.8, "right"),
        ),
        "duplicate",
        say="A duplicate of dex1_1: the same messages under a later time.",
    ),
    Wire("dex3_bag", "bag", _both("dex3_pinch", 12.0, 19.4), say="A bag, a whole-hand grasp."),
    Wire(
        "dex1_bag",
        "bag",
        (
            Cut("dex1_idle_then_startle", "left", 1.6, 13.0, "right"),
            Cut("dex1_idle_then_startle", "right", 1.6, 13.0, "left"),
        ),
        "idle_start",
        "",
        "moderate",
        at=0.0,
        until=6.5,
        say="6.5 s of standing still before the motion begins, of 11.4 s.",
    ),
    Wire(
        "dex1_off_bag",
        "bag",
        (
            Cut("dex1_hand_dropout", "left", 11.2, 19.4, "left"),
            Cut("dex1_hand_dropout", "right", 11.2, 19.4, "right"),
        ),
        "not_followed",
        "right_hand",
        "plain",
        say="The right hand's states stay at rest: it is off. Its commands move.",
    ),
    Wire(
        "xr_wire/episode_0000",
        "xr-dexkit",
        (
            Cut("dex1_pick_place", "left", 2.0, 12.0, "right"),
            Cut("dex1_pick_place", "right", 11.3, 21.3, "left"),
        ),
        say="Exported from the wire, with velocity, torque and times.",
    ),
    Wire(
        "xr_wire/episode_0001",
        "xr-dexkit",
        (
            Cut("dex1_pick_place", "left", 11.5, 19.7, "left"),
            Cut("dex1_hand_dropout", "right", 11.2, 19.4, "right"),
        ),
        "frozen_side",
        "left_hand",
        at=2.0,
        until=7.0,
        strength="moderate",
        say="The left gripper's states repeat the last message for 5 s.",
    ),
    Wire(
        "xr_wire/episode_0002",
        "xr-dexkit",
        (
            Cut("dex1_idle_then_startle", "right", 8.0, 15.6, "right"),
            Cut("dex1_hand_dropout", "right", 1.7, 9.3, "left"),
        ),
        say="Exported from the wire: quick strokes of the right gripper.",
    ),
    Wire(
        "xr_wire/episode_0003",
        "xr-dexkit",
        (
            Cut("dex1_idle_then_startle", "left", 8.0, 18.0, "left"),
            Cut("dex1_pick_place", "right", 2.0, 12.0, "right"),
        ),
        "wrong_side",
        "left_hand",
        say="The states of the grippers are exchanged, the commands are not.",
    ),
)


def _topics(sample: str, trace: Trace, side: str) -> dict[str, str]:
    """Topics of a side, and what is ``{}`` in them."""
    short = side[0] if "ftp" in sample else side
    return {
        t: t.removesuffix(f"/{short}") + "/{}" if "ftp" in sample else t.replace(short, "{}")
        for t in trace.topics
        if f"/{short}/" in f"{t}/"
    }


def _record(wire: Wire, path: Path, begin_ns: int) -> None:
    found: list[tuple[int, str, str, bytes, Any]] = []
    # states of a gripper that nobody commands, noise and all
    idle = Trace(SAMPLES / "dex1_idle_then_startle.mcap")
    off = [m.data for m in idle.messages(["rt/dex1/left/state"])][1000:3400]
    for cut in wire.cuts:
        trace = Trace(SAMPLES / f"{cut.sample}.mcap")
        names = _topics(cut.sample, trace, cut.side)
        first = min(m.log_time_ns for m in trace.messages())
        held: bytes | None = None
        for m in trace.messages(list(names)):
            t = (m.log_time_ns - first) / 1e9
            state = "state" in m.topic
            if not cut.begin <= t < cut.end:
                continue
            t -= cut.begin
            to, data = cut.to, m.data
            mine = wire.part in ("", f"{to}_hand")
            if wire.fault == "frozen_side" and mine and state and wire.at <= t < wire.until:
                data = held if held is not None else data
            elif wire.fault == "not_followed" and mine and state:
                data = off[len(found) % len(off)]
            else:
                held = data if state else held
            if wire.fault == "missing_stretch" and not wire.part and wire.at <= t < wire.until:
                continue
            if wire.fault == "action_shift" and not state:
                t -= wire.at
                if t < 0:
                    continue
            if wire.fault == "wrong_side" and (state or "touch" in m.topic):
                to = "right" if to == "left" else "left"
            topic = names[m.topic].format(to[0] if "ftp" in cut.sample else to)
            found.append((round(t * 1e9), topic, m.type_name, data, trace.definitions))
    found.sort(key=lambda row: row[0])
    with RecordingWriter(path) as writer:
        channels: dict[str, int] = {}
        for t_ns, topic, kind, data, definitions in found:
            if topic not in channels:
                sides = ("left", "right"), ("/l", "/r")
                same = {topic} | {topic.replace(a, b) for a, b in sides}
                same |= {topic.replace(b, a) for a, b in sides}
                known = next(d for (t, k), d in definitions.items() if t in same and k == kind)
                channels[topic] = writer.add_channel(replace(known, topic=topic))
            writer.put(channels[topic], data, begin_ns + t_ns, begin_ns + t_ns)


def write_wire(out: Path, work: Path) -> list[dict[str, Any]]:
    """Write the recordings, the bags and a task folder that dexkit exports; return their labels."""
    labels: list[dict[str, Any]] = []
    exported: list[Path] = []
    (out / "wire").mkdir()
    for number, wire in enumerate(WIRES):
        begin_ns = START_NS + number * 100_000_000_000
        form, dataset = wire.form, f"wire/{wire.name}.mcap"
        episode: str | None = None
        if form == "mcap":
            path = out / dataset
            _record(wire, path, begin_ns)
            if wire.fault == "broken_file":
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        else:
            path = work / f"{wire.name.replace('/', '_')}.mcap"
            _record(wire, path, begin_ns)
            if form == "bag":
                dataset = f"wire/{wire.name}"
                export_bag(Trace(path), out / dataset)
            else:
                dataset, episode = wire.name.split("/")
                exported.append(path)
        labels.append(
            {
                "dataset": dataset,
                "form": form,
                "episode": episode,
                "expect": "spoiled" if wire.fault else "good",
                "fault": wire.fault,
                "part": wire.part,
                "joints": [],
                "begin_s": wire.at if wire.until else None,
                "end_s": wire.until or None,
                "strength": wire.strength,
                "say": wire.say,
            }
        )
    traces = [Trace(p) for p in exported]
    export_episodes(traces, out / "xr_wire", fps=30, task="Move the parts to the other tray")
    return labels
