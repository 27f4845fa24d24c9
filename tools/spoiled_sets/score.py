"""Compare the verdicts of an audit with the labels of spoiled sets."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["REASONS", "Score", "read_rows", "score"]

_FROZEN = {"frozen", "repeated", "not-followed"}
REASONS: dict[str, set[str]] = {
    "frozen_joint": _FROZEN,
    "frozen_side": _FROZEN,
    "frozen_all": _FROZEN,
    "repeated_frames": {"repeated", "frozen", "fps"},
    "action_shift": {"out-of-step", "lag"},
    "lag_drift": {"out-of-step", "drift", "lag"},
    "clipped_action": {"clipped"},
    "not_followed": {"not-followed", "frozen"},
    "jump": {"jump"},
    "wrong_unit": {"units"},
    "wrong_side": {"sides"},
    "wrong_joint_order": {"order"},
    "inverted_sign": {"sign", "units"},
    "missing_stretch": {"missing", "jump"},
    "wrong_fps": {"fps", "camera-late", "camera-missing"},
    "duplicate": {"duplicate"},
    "idle_start": {"idle"},
    "idle_end": {"idle"},
    "grasp_on_nothing": {"grasp"},
    "drop_in_grasp": {"grasp"},
    "camera_frozen": {"camera-frozen"},
    "camera_late": {"camera-late"},
    "camera_early_end": {"camera-missing", "camera-late"},
    "camera_missing": {"camera-missing"},
    "no_task": {"task"},
    "wrong_stats": {"statistics"},
    "not_finite": {"missing", "readable"},
    "broken_file": {"readable", "missing", "statistics"},
}
"""By fault, the checks that give the right reason for it."""


@dataclass
class Score:
    """What an audit found of what is true.

    :ivar found: by fault, episodes found for the right reason; ``total`` of them there are.
    :ivar other: spoiled, to review or to drop for another reason than the fault.
    :ivar missed: spoiled, and kept; ``blamed`` are good, and are not kept.
    :ivar absent: labelled, and not in the audit.
    """

    total: Counter[str] = field(default_factory=Counter)
    found: Counter[str] = field(default_factory=Counter)
    good: int = 0
    other: list[str] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    blamed: list[str] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)

    def text(self) -> str:
        """The score in lines."""
        spoiled, found = self.total.total(), self.found.total()
        lines = [
            f"{found} of {spoiled} spoiled episodes found for the right reason "
            f"({100 * found / max(1, spoiled):.0f} %), {len(self.other)} for another one, "
            f"{len(self.missed)} kept; {len(self.blamed)} of {self.good} good ones blamed; "
            f"{len(self.absent)} not in the audit"
        ]
        for name, n in sorted(self.total.items()):
            lines.append(f"  {name:18} {self.found[name]:3} of {n}")
        for title in ("missed", "other", "blamed", "absent"):
            lines += [f"{title}: {text}" for text in getattr(self, title)]
        return "\n".join(lines)


def read_rows(out: Path) -> list[dict[str, Any]]:
    """The rows of the table of episodes in an audit's folder."""
    lines = out / "episodes.jsonl"
    if lines.exists():
        return [json.loads(line) for line in lines.read_text().splitlines()]
    import pyarrow.parquet as pq

    found: list[dict[str, Any]] = pq.read_table(out / "episodes.parquet").to_pylist()
    return found


def score(folder: Path, rows: Sequence[Mapping[str, Any]], root: str) -> Score:
    """The score of an audit.

    :param folder: of the sets, with ``labels.json``.
    :param rows: of the table of episodes.
    :param root: what the names of sources begin with: the folder as the audit was told.
    """
    result = Score()
    episodes: dict[tuple[str, str], Mapping[str, Any]] = {}
    sets: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        place = (row["source"] or row["episode"]).removeprefix(root).strip("/")
        reasons = json.loads(row["reasons"])
        if row["is_set"]:
            sets.setdefault(place, []).extend(reasons)
        else:
            number = row["number"] or row["episode"].removeprefix(row["source"]).strip("/")
            episodes[place, number if row["source"] else ""] = row
    labels = json.loads((folder / "labels.json").read_text())
    copies = {
        _short(label) for label in labels if label["fault"] == "duplicate"
    }  # which of the two is the copy cannot be told
    for label in labels:
        number = label["episode"]
        dataset = label["dataset"].strip("/")
        key = (dataset, "" if number is None else str(number))
        name = f"{dataset} {'' if number is None else number}"
        mine = episodes.get(key) or episodes.get((dataset, ""))
        if label["fault"] == "duplicate" or label["expect"] == "good":
            mine = _without_pairs(label, mine, episodes, copies)
        _count(result, label, mine, sets.get(dataset, []), name)
    return result


def _short(label: Mapping[str, Any]) -> str:
    """How findings call an episode, at the end of its name."""
    number = label["episode"]
    if isinstance(number, int):
        return f"episode_{number:06d}"
    return str(number or Path(label["dataset"]).name)


def _without_pairs(
    label: Mapping[str, Any],
    row: Mapping[str, Any] | None,
    episodes: Mapping[tuple[str, str], Mapping[str, Any]],
    copies: set[str],
) -> Mapping[str, Any] | None:
    """The row with "it is a copy" moved from the original to the copy."""
    if row is None:
        return None
    reasons = json.loads(row["reasons"])
    if label["fault"]:
        for other in episodes.values():
            if other["source"] == row["source"]:
                reasons += [
                    r
                    for r in json.loads(other["reasons"])
                    if r["check"] == "duplicate" and _short(label) in r["text"]
                ]
    else:
        reasons = [
            r
            for r in reasons
            if r["check"] != "duplicate" or not any(name in r["text"] for name in copies)
        ]
    return {**row, "reasons": json.dumps(reasons)}


def _count(
    result: Score,
    label: Mapping[str, Any],
    row: Mapping[str, Any] | None,
    of_set: Sequence[Mapping[str, Any]],
    name: str,
) -> None:
    reasons = [] if row is None else json.loads(row["reasons"])
    told = "; ".join(f"{r['use']} {r['check']} {r['part']}: {r['text']}" for r in reasons)
    unusable = row is not None and row["exit_code"] == 2 and not row["verdict"]
    if label["expect"] == "good":
        result.good += 1
        if row is None:
            result.absent.append(f"{name} (good)")
        elif reasons or unusable:
            result.blamed.append(f"{name} ({label['say']}): {told or row['error']}")
        return
    fault = label["fault"]
    result.total[fault] += 1
    if row is None and fault != "broken_file":
        result.absent.append(f"{name} ({fault})")
        return
    right = [r for r in [*reasons, *of_set] if r["check"] in REASONS[fault] and _is_there(r, label)]
    if right or (fault == "broken_file" and (row is None or unusable)):
        result.found[fault] += 1
    elif reasons or unusable:
        shown = told or (row["error"] if row else "")
        result.other.append(f"{name} ({fault} {label['part']}: {label['say']}): {shown}")
    else:
        result.missed.append(f"{name} ({fault} {label['part']}: {label['say']})")


def _is_there(reason: Mapping[str, Any], label: Mapping[str, Any]) -> bool:
    """Whether a reason names the part of the fault, or the whole robot."""
    part, wanted = reason["part"], label["part"]
    if not part or not wanted or part == wanted or part.startswith("camera"):
        return True
    both = {"left_hand": "hands", "right_hand": "hands", "left_arm": "arms", "right_arm": "arms"}
    return both.get(wanted, "-") in part or wanted in part or part in ("robot", "both")
