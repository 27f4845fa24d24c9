"""Waiting without a tight clock."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

__all__ = ["WaitTimeout", "open_files", "until"]

PATIENCE = 60.0
"""Seconds that something may take which takes one on an idle machine."""


class WaitTimeout(Exception):
    """A condition was not true in time."""


def until(condition: Callable[[], Any], what: str, timeout: float = PATIENCE) -> Any:
    """Poll ``condition`` until it is true; its value.

    :raises WaitTimeout: it was not within ``timeout`` seconds.
    """
    end = time.monotonic() + timeout
    while True:
        found = condition()
        if found:
            return found
        if time.monotonic() > end:
            raise WaitTimeout(f"waited {timeout:g} s for {what}")
        time.sleep(0.01)


def open_files() -> int:
    """Open file descriptors of this process."""
    return len(os.listdir("/proc/self/fd"))
