"""Write which episodes to drop, and the commands that make the cleaned set of them."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from dexkit.conformance.audit.records import EpisodeRecord
from dexkit.conformance.audit.sessions import is_url
from dexkit.conformance.dataset.findings import Use

__all__ = ["EPISODES", "cleaning_commands", "episodes_listing"]

EPISODES = "episodes.json"
"""Name of the list of episodes in the audit's folder; ``dexkit export --drop`` reads it."""
_MOST = 200  # numbers on a command line


def episodes_listing(
    records: Iterable[EpisodeRecord], working_folder: Path | None = None
) -> Iterator[bytes]:
    """The verdict on each episode, as JSON, in pieces.

    :param working_folder: what relative paths are relative to; None for the process' own.
    """
    yield b'{"format": "dexkit-episodes", "version": 1, "episodes": ['
    separator = b"\n"
    for record in records:
        if record.is_set or not record.use:
            continue
        assert record.judgement is not None
        source = record.source or record.name
        row: dict[str, Any] = {
            "source": source,
            "place": source if is_url(source) else _absolute(source, working_folder),
            "episode": int(record.episode) if record.episode.isdecimal() else record.episode,
            "verdict": record.use,
            "reasons": [finding.text for finding in record.judgement.reasons],
        }
        yield separator + json.dumps(row, ensure_ascii=True).encode()
        separator = b",\n"
    yield b"\n]}\n"


def _absolute(source: str, working_folder: Path | None) -> str:
    return os.path.abspath((working_folder or Path()) / source)


def cleaning_commands(records: Iterable[EpisodeRecord], listing: Path) -> list[tuple[str, str]]:
    """What makes the cleaned sets: caption and command line, for each set with episodes to drop."""
    dropped: dict[tuple[str, str], list[str]] = {}
    for record in records:
        if record.use == Use.DROP and record.source and not record.is_set:
            dropped.setdefault((record.source, record.form), []).append(record.episode)
    found = []
    for (source, form), episodes in sorted(dropped.items()):
        if is_url(source):
            continue
        out = source.rstrip("/") + "-clean"
        command = ["dexkit", "export", source, out, "--drop", str(listing)]
        count = f"{len(episodes)} episode{'s' if len(episodes) > 1 else ''}"
        found.append((f"{source} without {count}", shlex.join(command)))
        if form == "LeRobot v3.0" and len(episodes) <= _MOST:
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
