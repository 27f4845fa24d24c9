"""Time in tests that hold on any machine.

What must come is waited for: :data:`PATIENCE` only ends a test that has failed. That something does
not wait longer than it says is told by what it asks the system for, see :func:`waits_of`: how late
the system ends a wait is a matter of the machine.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

__all__ = ["PATIENCE", "waits_of"]

PATIENCE = 60.0
"""Seconds after which what a test waits for will not come any more."""


def waits_of(
    monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, asked: Callable[..., float]
) -> list[float]:
    """A list that gets the seconds of each wait by ``owner.name`` in the calling thread.

    A wait that ends early counts what it took, one that ends late what it asked for.

    :param asked: seconds that a call with these arguments asks for.
    """
    thread, wait, waits = threading.get_ident(), getattr(owner, name), []

    def timed(*arguments: Any) -> Any:
        wanted, begin = asked(*arguments), time.monotonic()
        try:
            return wait(*arguments)
        finally:
            if threading.get_ident() == thread:
                waits.append(min(wanted, time.monotonic() - begin))

    monkeypatch.setattr(owner, name, timed)
    return waits
