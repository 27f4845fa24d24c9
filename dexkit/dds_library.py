"""Which CycloneDDS libraries a process has loaded: two of them crash it, or make it hang."""

from __future__ import annotations

import os
import re
from pathlib import Path

__all__ = ["is_library", "loaded_here", "loaded_libraries"]

# libddsc.so.0.10.5, or with the digest that a wheel adds: libddsc-fc204970.so.0.10.5; libddscxx is
# the C++ binding, which uses the C library
_NAME = re.compile(r"libddsc(-[0-9a-f]+)?\.so")


def is_library(path: str) -> bool:
    """Whether a file is the C library of CycloneDDS, by its name."""
    return _NAME.match(os.path.basename(path)) is not None


def loaded_libraries(maps: str) -> tuple[str, ...]:
    """Files of the library in the text of ``/proc/PID/maps``, sorted."""
    paths = [line.split(maxsplit=5)[5].strip() for line in maps.splitlines() if "/" in line]
    return tuple(sorted({path for path in paths if is_library(path)}))


def loaded_here() -> tuple[str, ...]:
    """The libraries that this process has loaded; empty where the system does not list them."""
    try:
        return loaded_libraries(Path("/proc/self/maps").read_text(errors="replace"))
    except OSError:
        return ()
