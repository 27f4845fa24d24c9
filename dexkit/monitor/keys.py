"""Bytes of a terminal to names of keys; sans IO."""

from __future__ import annotations

import re

__all__ = ["keys"]

_ESCAPES = {
    b"[A": "up",
    b"OA": "up",
    b"[B": "down",
    b"OB": "down",
    b"[5~": "page up",
    b"[6~": "page down",
}
_KEY = re.compile(rb"\x1b(?:\[[0-9;?]*[ -/]*[@-~]|O.|)|[^\x1b]", re.DOTALL)


def keys(data: bytes) -> list[str]:
    """The keys that were pressed, in order: a character, or ``up``, ``page down``, ...

    Keys without a name are left out, as is what a terminal answers by itself.
    """
    found = []
    for match in _KEY.finditer(data):
        text = match[0]
        if text.startswith(b"\x1b"):
            if name := _ESCAPES.get(text[1:]):
                found.append(name)
        elif text.isascii():
            found.append(text.decode())
    return found
