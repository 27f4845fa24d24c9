"""What lerobot-doctor says, as findings.

``check --json`` prints sentences, some of them about one episode, some with a list of the first few
episodes. ``score --json`` prints a score for each episode and which to drop.
"""

from __future__ import annotations

import json
import re

from benchmarks.dataset_peers import Finding

__all__ = ["checked", "scored"]

_LEVELS = {"WARN": "warning", "FAIL": "failure"}

_WORDS = (
    ("zero-std", r"zero std"),
    ("not-finite", r"\bNaN\b|\bInf\b"),
    ("timestamps-order", r"non-monotonic"),
    ("frame-gaps", r"dropped frame"),
    ("rate", r"Mean interval|video fps="),
    ("frame-numbers", r"frame_index not sequential|index column is not|Missing episode indices"),
    ("frozen-actions", r"\bfrozen\b"),
    ("action-jumps", r"action jump"),
    ("clipped", r"of values at (minimum|maximum)"),
    ("constant", r"zero variance|constant dimension|dimensions constant"),
    ("outliers", r"extreme outlier"),
    ("video-missing", r"[Vv]ideo files? missing|video files missing"),
    ("video-decode", r"failed to decode"),
    ("video-frames", r"has \d+ frames, expected"),
    ("video-size", r"resolution \d+x\d+"),
    ("stats", r"stats\.json"),
    ("short", r"shorter than|too short|<=1 frame|empty episode|single frame|abnormally short"),
    ("long", r"abnormally long"),
    ("lengths", r"length mismatch|length variance|total_frames|total_episodes"),
    ("features", r"missing features|extra features|mismatch\(es\)|declared in info|inconsistent"),
    ("duplicate", r"near-duplicate"),
    ("stuck", r"stuck/static"),
    ("shift", r"distribution shift"),
    ("tasks", r"task metadata|task imbalance"),
    ("files", r"directory not found|No parquet|metadata not found|info\.json"),
)
"""A short word for each kind of sentence; the first that fits."""

_ONE = re.compile(r"\b[Ee]pisode (\d+)\b")
_PAIRS = re.compile(r"\(\d+, (\d+)\)")
_ROWS = re.compile(r"\((\d+), ")
_LIST = re.compile(r"(?:episodes |: )\[([\d, ]+)\]")
_VIDEO = re.compile(r"/episode_(\d+)\.mp4 ")


def checked(printed: str) -> list[Finding]:
    """Findings of ``check --json``."""
    found = []
    for check in json.loads(printed)["checks"]:
        for message in check["messages"]:
            if message["severity"] in _LEVELS:
                level = _LEVELS[message["severity"]]
                found += _findings(check["name"], level, message["message"])
    return found


def scored(printed: str) -> list[Finding]:
    """Findings of ``score --json``: those that it recommends to drop."""
    said = json.loads(printed)
    scores = {entry["ep"]: entry["score"] for entry in said["scores"]}
    return [
        Finding("score", "warning", str(episode), f"score {scores[episode]} of 100: drop")
        for episode in said["recommended_drops"]
    ]


def _findings(check: str, level: str, text: str) -> list[Finding]:
    """One for each episode that the sentence names, or one for the set."""
    if check == "Per-Episode Summary" and (named := _ONE.match(text)):
        reasons = text[named.end() :].removeprefix(": ").split("; ")
        return [Finding(_word(r), level, named[1], r) for r in reasons]
    return [Finding(_word(text, check), level, episode, text) for episode in _episodes(text)]


def _episodes(text: str) -> list[str]:
    if "near-duplicate" in text:
        return _PAIRS.findall(text)  # of each pair the later one
    if ": [(" in text:
        return _ROWS.findall(text) or [""]
    if one := _VIDEO.search(text) or _ONE.search(text):
        return [str(int(one[1]))]
    many = _LIST.search(text)
    return re.findall(r"\d+", many[1]) if many else [""]


def _word(text: str, check: str = "other") -> str:
    return next((word for word, pattern in _WORDS if re.search(pattern, text)), check)
