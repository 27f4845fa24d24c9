"""Count who has found which fault, with the labels of sets of known faults.

A spoiled episode is

- *found* if a program names the episode for a reason that fits the fault. What fits is stated
  generously here: for a frozen joint every word about values that do not change or do not follow;
- *named* if it names the episode for other reasons only;
- found *in the set* if only a sentence about the whole set fits;
- *not read* if the program has judged nothing of this set.

A good episode is blamed if it is named at all.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.dataset_peers import LEVELS, Finding, Run
from tools.spoiled_sets.score import REASONS

__all__ = ["GOOD", "Label", "labels", "outcome", "scores"]

GOOD = "good"

_STANDS = {"DEAD_JOINT", "FROZEN_STATE", "stuck", "constant", "frozen-actions"}
_APART = {"ACTION_STATE_DIVERGENCE", "ACTION_RANGE_MISMATCH"}
_JUMPS = {"JITTER", "DISCONTINUITY", "action-jumps", "outliers"}
_VALUES = {*_APART, *_JUMPS, "shift", "UNITS_UNKNOWN"}
_CLIPPED = {"SATURATED_JOINT", "clipped"}
_TIMES = {
    *("TIMESTAMP_NON_MONOTONIC", "FRAME_DROPS", "FPS_MISMATCH"),
    *("timestamps-order", "frame-gaps", "rate", "frame-numbers"),
}
_VIDEO = {
    *("VIDEO_LENGTH_MISMATCH", "FROZEN_CAMERA", "DEGENERATE_IMAGE", "EPISODE_LOAD_ERROR"),
    *("video-missing", "video-decode", "video-frames", "video-size", "rate"),
}
_LONG = {"DURATION_OUTLIER", "long", *_STANDS}
_BROKEN = {
    "unreadable",
    "EPISODE_LOAD_ERROR",
    "NO_EPISODES",
    "lengths",
    "features",
    "files",
    "frame-numbers",
}

_PEERS: Mapping[str, set[str]] = {
    "frozen_joint": _STANDS | _APART | _CLIPPED,
    "frozen_side": _STANDS | _APART | _CLIPPED,
    "frozen_all": _STANDS | _APART | _CLIPPED,
    "repeated_frames": _STANDS | _TIMES,
    "action_shift": _APART,
    "lag_drift": _APART,
    "clipped_action": _CLIPPED | _APART,
    "not_followed": _STANDS | _APART | _CLIPPED,
    "jump": _JUMPS,
    "wrong_unit": _VALUES,
    "wrong_side": _APART,
    "wrong_joint_order": _APART,
    "inverted_sign": _APART,
    "missing_stretch": _TIMES | _JUMPS | {"lengths"},
    "wrong_fps": _TIMES | {"video-frames"},
    "duplicate": {"duplicate", "LOW_DIVERSITY"},
    "idle_start": _LONG,
    "idle_end": _LONG,
    "grasp_on_nothing": {"GRIPPER_INERT"} | _APART,
    "drop_in_grasp": _APART,
    "camera_frozen": _VIDEO,
    "camera_late": _VIDEO,
    "camera_early_end": _VIDEO,
    "camera_missing": _VIDEO,
    "no_task": {"MISSING_TASK", "tasks"},
    "wrong_stats": {"stats", "zero-std"},
    "not_finite": {"not-finite", "EPISODE_LOAD_ERROR"},
    "broken_file": _BROKEN,
}
"""Of each fault: the words of lerobot-doctor and lerobot-lint that fit it, beside dexkit's own."""


@dataclass(frozen=True)
class Label:
    """What is known of an episode.

    :param episode: number or folder name; empty: the dataset is this episode.
    :param fault: class of its fault, or :data:`GOOD`.
    """

    dataset: Path
    episode: str
    fault: str


def labels(path: Path) -> list[Label]:
    """Read a labels file.

    It is a JSON list of objects with ``dataset`` (relative to the file's folder), ``episode``
    (number, name or null), ``expect`` (``good`` or ``spoiled``) and ``fault``.
    """
    return [
        Label(
            (path.parent / row["dataset"]).resolve(),
            "" if row["episode"] is None else str(row["episode"]),
            GOOD if row["expect"] == GOOD else row["fault"],
        )
        for row in json.loads(path.read_text())
    ]


def outcome(label: Label, run: Run, level: str = "warning") -> str:
    """What a program made of an episode: ``found``, ``named``, ``in the set``, ``not read`` or "".

    :param level: milder findings do not count.
    """
    if run.trouble:
        return "not read"
    loud = [f for f in run.findings if LEVELS.index(f.level) >= LEVELS.index(level)]
    here = [f for f in loud if not label.episode or f.episode == label.episode]
    if any(_fits(f, label.fault) for f in here):
        return "found"
    if here:
        return "named"
    whole = [f for f in loud if not f.episode]
    return "in the set" if any(_fits(f, label.fault) for f in whole) else ""


def scores(
    known: Sequence[Label], runs: Iterable[Run], level: str = "warning"
) -> dict[str, dict[str, Counter[str]]]:
    """Of each class of faults, and of the good ones: the outcomes of each program.

    :returns: by fault and program; a label whose set the program was not run on is not counted.
    """
    found: dict[str, dict[str, Counter[str]]] = {}
    of_set: dict[Path, list[Label]] = {}
    for label in known:
        of_set.setdefault(label.dataset, []).append(label)
    for run in runs:
        for label in of_set.get(run.dataset, ()):
            counts = found.setdefault(label.fault, {}).setdefault(run.tool, Counter())
            counts[outcome(label, run, level)] += 1
            counts["episodes"] += 1
    return dict(sorted(found.items(), key=lambda item: (item[0] == GOOD, item[0])))


def _fits(finding: Finding, fault: str) -> bool:
    return finding.check in _PEERS.get(fault, ()) or finding.check in REASONS.get(fault, ())
