"""Read sessions from JSON lines: one frame per line, in the form of xr_teleoperate's items.

A line is an object with ``states`` and ``actions`` as in a ``data.json``, and ``timestamp_ns`` or
``timestamp`` (seconds) if there are times. A first line without them may hold ``info`` and
``text``. A line that cannot be read is skipped and reported.
"""

from __future__ import annotations

import json
from pathlib import Path

from dexkit.errors import SessionError
from dexkit.traces.sessions.episodes import DEFAULT, Document, Options, session_of
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
            found = json.loads(line.decode("utf-8-sig" if number == 1 else "utf-8"))
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
    try:
        data = path.read_bytes() if path.stat().st_size <= _LARGEST else None
    except OSError as error:
        raise SessionError(f"cannot read {path}: {error.strerror}") from error
    if data is None:
        raise SessionError(f"cannot read {path}: it is larger than {_LARGEST >> 30} GB")
    document, bad = parse_lines(data)
    if not document.items:
        raise SessionError(f"{path} has no frame: no line has 'states' or 'actions'")
    session = session_of(document, path, path.parent, "JSON lines", options)
    for place in bad:
        session.problems.add("lines that are no JSON object are left out", place)
    session.name = path.stem
    return session
