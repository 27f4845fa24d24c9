"""Read sessions from JSON lines: one frame per line, in the form of xr_teleoperate's items.

A line is an object with ``states`` and ``actions`` as in a ``data.json``, and ``timestamp_ns`` or
``timestamp`` (seconds) if there are times. A first line without them may hold ``info`` and
``text``. A line that cannot be read is skipped and reported.
"""

from __future__ import annotations

import json
from pathlib import Path

from dexkit.documents import limit_depth, read_bytes
from dexkit.errors import SessionError
from dexkit.traces.sessions.episodes import DEFAULT, Document, Options, session_of, whole_number
from dexkit.traces.sessions.model import Session

__all__ = ["parse_lines", "read_lines"]

_LARGEST = 1 << 30


def parse_lines(data: bytes) -> tuple[Document, list[str]]:
    """The frames of a file, and the numbers of unreadable lines."""
    document, bad = Document(), []
    for number, line in enumerate(data.splitlines(), 1):
        if not line.strip():
            continue
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8")
            found = json.loads(text, parse_int=whole_number)
            limit_depth(found)
        except (ValueError, RecursionError):
            bad.append(f"line {number}")
            continue
        if not isinstance(found, dict):
            bad.append(f"line {number}")
        elif "states" in found or "actions" in found:
            document.items.append(found)
        else:
            for key in ("info", "text"):
                if isinstance(found.get(key), dict):
                    setattr(document, key, found.pop(key))
            document.rest.update(found)
    return document, bad


def read_lines(path: Path, options: Options = DEFAULT) -> Session:
    """Read one file.

    :raises SessionError: it cannot be read, or has no frame.
    """
    document, bad = parse_lines(read_bytes(path, _LARGEST, error=SessionError))
    if not document.items:
        raise SessionError(f"{path} has no frame: no line has 'states' or 'actions'")
    session = session_of(document, path, path.parent, "JSON lines", options)
    for place in bad:
        session.problems.add("lines that are no JSON object are left out", place)
    session.name = path.stem
    return session
