"""Write which episodes to drop, and the commands that make the cleaned set of them."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from dexkit.conformance.audit.records import EpisodeRecord, State
from dexkit.conformance.audit.sessions import is_url
from dexkit.conformance.dataset.findings import Use

__all__ = ["EPISODES", "cleaning_commands", "episodes_listing"]

EPISODES = "episodes.json"
"""Name of the list of episodes in the audit's folder; ``dexkit export --drop`` reads it."""
_MOST = 200  # numbers on a command line
_BROKEN = (State.UNREADABLE, State.GONE)


def episodes_listing(
    records: Iterable[EpisodeRecord], working_folder: Path | None = None
) -> Iterator[bytes]:
    """The verdict on each episode, as JSON, in pieces.

    :param working_folder: what relative paths are relative to; None for the process' own.
    """
    yield b'{"format": "dexkit-episodes", "version": 1, "episodes": ['
    separator = b"\n"
    for record in records:
        verdict = _verdict(record)
        if record.is_set or not verdict:
            continue
        judged = record.judgement
        source = record.source or record.name
        row: dict[str, Any] = {
            "source": source,
            "place": source if is_url(source) else _absolute(source, working_folder),
            "episode": int(record.episode) if _is_number(record) else record.episode,
            "verdict": verdict,
            "reasons": [f.text for f in judged.reasons] if judged else [record.error],
        }
        yield separator + json.dumps(row, ensure_ascii=True).encode()
        separator = b",\n"
    yield b"\n]}\n"


def _verdict(record: EpisodeRecord) -> str:
    """Keep, review or drop. What cannot be read cannot be trained on either; empty where storage
    or audit failed.
    """
    in_set = bool(record.source and record.episode)
    broken = in_set and record.judgement is None and record.state in _BROKEN
    return str(Use.DROP) if broken else record.use


def _is_number(record: EpisodeRecord) -> bool:
    """Whether the episode is a number in a dataset; folders have names of digits, too."""
    return record.episode.isdecimal() and Path(record.name).name != record.episode


def _absolute(source: str, working_folder: Path | None) -> str:
    return os.path.abspath((working_folder or Path()) / source)


def cleaning_commands(records: Iterable[EpisodeRecord], listing: Path) -> list[tuple[str, str]]:
    """What makes the cleaned sets: caption and command line, for each set with episodes to drop."""
    dropped: dict[str, list[str]] = {}
    forms: dict[str, str] = {}
    for record in records:
        if _verdict(record) == Use.DROP and record.source and not record.is_set:
            dropped.setdefault(record.source, []).append(record.episode)
            # of what cannot be read the form is not known
            forms[record.source] = forms.get(record.source) or record.form
    found = []
    for source, episodes in sorted(dropped.items()):
        if is_url(source):
            continue
        out = source.rstrip("/") + "-clean"
        command = ["dexkit", "export", source, "--out", out, "--drop", str(listing)]
        count = f"{len(episodes)} episode{'s' if len(episodes) > 1 else ''}"
        found.append((f"{source} without {count}", shlex.join(command)))
        if forms[source] == "LeRobot v3.0" and len(episodes) <= _MOST:
            numbers = f"[{', '.join(sorted(episodes, key=int))}]"
            name = Path(source).name
            command = [
                "lerobot-edit-dataset",
                *("--repo_id", f"local/{name}", "--root", source),
                *("--new_repo_id", f"local/{name}-clean", "--new_root", out),
                *("--operation.type", "delete_episodes"),
                *("--operation.episode_indices", numbers),
            ]
            found.append(("the same with LeRobot's own tool", shlex.join(command)))
    return found
